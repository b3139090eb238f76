"""The commands of the laboratory, which the command line of `fide_plugins` finds.

==================  ===================================================================
`NAME_command`      one module for each command: its arguments and its execution
`fit_model`         `fide fit` with a task that draws the picture
`grid_arguments`    arguments that `fide compare` and `fide tradeoff` share
`own_task`          a task made of a renderer of one's own, as the command line names it
`suite_arguments`   arguments that choose a part of a suite
`running`           executes runs and comparisons, with messages and exit codes
==================  ===================================================================
"""

COMMANDS = {
    "run": "fit a built-in task, or a test of your renderer",
    "compare": "compare optimizers on tasks",
    "report": "write the page, tables and figures of a comparison",
    "tradeoff": "sweep options that trade speed for accuracy",
}
"""What each is for."""
