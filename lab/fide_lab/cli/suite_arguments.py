"""`fide compare --suite NAME`: arguments that choose a part of a suite, and its plan."""

from __future__ import annotations

import argparse
from typing import Any

from fide_plugins.cli.arguments import names, whole
from fide_plugins.cli.messages import note, plain
from fide_plugins.errors import OptionError
from fide_plugins.runtime.messages import counted

__all__ = ["add_suite_arguments", "check_no_suite", "suite_plan"]

_FIXED = (
    "tasks", "template", "space", "target", "timeout", "losses", "metrics", "size", "seeds",
    "task_seed", "task_set", "options", "threshold",
)  # fmt: skip
"""Arguments that a suite does not leave open."""
_FLAGS = {"tasks": "a TASK", "template": "--command", "options": "--set"}


def add_suite_arguments(parser: argparse.ArgumentParser) -> None:
    """Add --suite, and what chooses a part of it."""
    suite = parser.add_argument_group("a suite")
    add = suite.add_argument
    add("--suite", metavar="NAME", help="fixed set of problems, such as image-fitting-v1")
    add("--scenes", type=names, metavar="A,B", help="scenes of the suite (all)")
    add("--targets", type=whole(1), metavar="N", help="its first N targets of each scene (all)")


def check_no_suite(args: argparse.Namespace) -> None:
    """Raise OptionError for an argument that chooses a part of a suite where none is named."""
    for name in ("scenes", "targets"):
        if getattr(args, name) is not None:
            raise OptionError(f"--{name} is of a suite; add --suite NAME, or leave it out")


def suite_plan(args: argparse.Namespace) -> Any:
    """Plan of the chosen part; scenes that cannot be rendered here are left out, with a line.

    Raises OptionError for arguments that a suite does not leave open, and if no scene is left.
    """
    from fide_lab.compare import Configuration
    from fide_lab.suite import problems, read

    for name in _FIXED:
        if getattr(args, name):
            flag = _FLAGS.get(name, "--" + name.replace("_", "-"))
            raise OptionError(f"{flag} has no meaning with --suite, which is fixed; leave it out")
    configurations = [Configuration.parse(text) for text in args.optimizers]
    suite = read(args.suite)
    scenes, targets = suite.chosen(args.scenes, args.targets)
    plan = problems.plan(suite, configurations, scenes, targets, args.budget)
    plan.check_optimizers()  # before a target of each scene is rendered, which takes a minute
    missing = problems.unavailable(suite, scenes)
    for scene, why in missing.items():
        note(f"{scene} of {suite.name} is left out, it cannot be rendered here: {plain(why)}")
    left = [scene for scene in scenes if scene not in missing]
    if not left:
        raise OptionError(f"no scene of {suite.name} is left; choose others by --scenes")
    plan = problems.plan(suite, configurations, left, targets, args.budget)
    note(_size_of(plan))
    return plan


def _size_of(plan: Any) -> str:
    """How many runs there are, so that nobody starts a week's work for an evening's."""
    runs = len(list(plan.runs()))
    each = f"{counted(runs, 'run')} of {plan.budget} renders{' each' * (runs != 1)}"
    return f"{plan.suite.name}: {each} (--scenes, --targets and --budget choose a part)"
