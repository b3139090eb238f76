"""Arguments that commands of the laboratory share."""

from __future__ import annotations

import argparse
import math
import shlex
from pathlib import Path
from typing import Any

from fide_plugins.cli.arguments import add_space_argument, path, setting, whole
from fide_plugins.cli.terminal import note, plain
from fide_plugins.errors import OptionError
from fide_plugins.runtime.messages import counted


def thresholds(text: str) -> tuple[str, float]:
    """Parse ``loss=value`` or ``task/loss=value`` with a finite value."""
    key, _, value = text.rpartition("=")
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not key or not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"LOSS=VALUE or TASK/LOSS=VALUE, not {text!r}")
    return key, number


def names(text: str) -> list[str]:
    """Parse names separated by commas; those in brackets, ``fide:x0=[0,1]``, are of a name."""
    found, depth = [""], 0
    for character in text:
        depth += (character in "[{") - (character in "]}")
        if character == "," and not depth:
            found.append("")
        else:
            found[-1] += character
    found = [name.strip() for name in found]
    if not all(found):
        raise argparse.ArgumentTypeError(f"names separated by commas, not {text!r}")
    return found


def add_grid_arguments(
    parser: argparse.ArgumentParser, *, what: str, seeds: int, budget: int
) -> Any:
    """Add the arguments that `fide compare` and `fide tradeoff` share; seeds, budget: defaults.

    Returns the group of --jobs, for arguments that exclude it.
    """
    add = parser.add_argument
    add("--seeds", type=whole(1), default=seeds, metavar="N", help=f"runs of each ({seeds})")
    add("--budget", type=whole(1), default=budget, metavar="N",
        help=f"renders of each run ({budget})")  # fmt: skip
    add("--task-seed", type=whole(0), default=0, metavar="N", help="chooses the target (0)")
    add("--task-set", type=setting, action="append", default=[], metavar="KEY=VALUE",
        help="any option of the tasks, such as cells=12; may be repeated")  # fmt: skip
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--jobs", type=whole(1), default=1, metavar="J", help="processes (1)")
    add("--out", type=path, required=True, metavar="DIR", help=f"directory of the {what}")
    add("--resume", action="store_true", help=f"continue or extend the {what} in that directory")
    return where


# -- a task made of a renderer of one's own, as the command line names it --------------------------


def add_own_task(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `fide run` and `fide compare` that make a task of a renderer."""
    own = parser.add_argument_group("your renderer")
    add_space_argument(own)
    add = own.add_argument
    add("--command", dest="template", metavar="'PROGRAM ...'",
        help="your program in place of TASK; see: fide fit --help")  # fmt: skip
    add("--timeout", metavar="TIME", help="of a render by --command, such as 60 or 2m (60)")
    add("--target", metavar="FILE", help="picture to fit (the image of random parameters)")


def task_of(args: argparse.Namespace) -> str:
    """Name of the task that --command makes: that of its program; OptionError beside a TASK."""
    if args.task if "task" in args else args.tasks:
        raise OptionError("give a TASK or --command, not both")
    try:
        return Path(shlex.split(args.template)[0]).name or "command"
    except (ValueError, IndexError):  # the renderer says what is wrong with it
        return "command"


def options_of(args: argparse.Namespace) -> dict[str, Any]:
    """Options of the task from the arguments of `add_own_task`; OptionError for a wrong one.

    `args.size` is None where no --size is given.
    """
    from fide_plugins.runtime.registry import is_reference
    from fide_plugins.validation.options import seconds_of

    if args.timeout is not None and args.template is None:
        raise OptionError("--timeout is of --command; leave it out")
    named = args.tasks if "tasks" in args else [args.task]
    built_in = [] if args.template is not None else [t for t in named if not is_reference(t)]
    if args.target is not None and built_in:
        raise OptionError(
            f"--target is for a renderer of your own, and {built_in[0]} makes its own target; "
            "leave it out, or fit the picture, see: fide fit --help"
        )
    if args.size is not None and not built_in:
        raise OptionError(
            "--size is for built-in tasks; a renderer of your own has its own size: change it there"
        )
    given = {"space": args.space, "target": args.target, "command": args.template}
    if args.timeout is not None:
        given["timeout"] = seconds_of("timeout", args.timeout)
    return {name: value for name, value in given.items() if value is not None}


# -- `fide compare --suite NAME`: arguments that choose a part of a suite, and its plan ------------

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
    configurations = list(map(Configuration.parse, args.optimizers))
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
    runs = counted(len(list(plan.runs())), "run")
    note(f"{suite.name}: {runs} of {plan.budget} renders (--scenes, --targets, --budget: a part)")
    return plan
