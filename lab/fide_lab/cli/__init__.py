"""The commands of the laboratory, which the command line of `fide_plugins` finds.

==============  =====================================================================
`NAME_command`  one module for each command: its arguments and its execution
`fit_model`     `fide fit` with a task that draws the picture
`arguments`     arguments that commands share: of grids, suites, and one's own renderer
`running`       executes runs and comparisons, with messages and exit codes
==============  =====================================================================
"""

COMMANDS = {
    "run": "fit a built-in task, or a test of your renderer",
    "compare": "compare optimizers on tasks",
    "report": "write the page, tables and figures of a comparison",
    "tradeoff": "sweep options that trade speed for accuracy",
}
"""What each is for."""
