"""The commands of the laboratory, which the command line of `fide_plugins` finds here."""

COMMANDS = {
    "check": "look at your renderer before a fit",
    "solutions": "show several good answers of a run, side by side",
    "watch": "show a run in the browser while it goes on",
    "run": "fit a built-in task, or a test of your renderer",
    "compare": "compare optimizers on tasks",
    "report": "write the page of a comparison",
    "tradeoff": "sweep options that trade speed for accuracy",
    "list": "list tasks, optimizers, encoders, losses",
    "doctor": "check what can be used on this machine",
}
"""What each is for."""
