"""A task made of a renderer of one's own, as the command line names it."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import Any

from fide_plugins.cli.arguments import add_space_argument
from fide_plugins.errors import OptionError

__all__ = ["add_own_task", "options_of", "task_of"]


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
    """Name of the task that --command makes: that of its program.

    Raises OptionError if a command stands beside a task.
    """
    beside = args.task if "task" in args else args.tasks
    if beside:
        raise OptionError("give a TASK or --command, not both")
    try:
        return Path(shlex.split(args.template)[0]).name or "command"
    except (ValueError, IndexError):  # the renderer says what is wrong with it
        return "command"


def options_of(args: argparse.Namespace) -> dict[str, Any]:
    """Options of the task from the arguments of `add_own_task`; OptionError for a wrong one.

    `args.size` is None where no --size is given.
    """
    from fide_plugins.validation.options import seconds_of

    if args.timeout is not None and args.template is None:
        raise OptionError("--timeout is of --command; leave it out")
    built_in = _built_in(args)
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


def _built_in(args: argparse.Namespace) -> list[str]:
    """Tasks that are no renderers of the user."""
    from fide_plugins.runtime.registry import is_reference

    named = args.tasks if "tasks" in args else [args.task]
    return [] if args.template is not None else [task for task in named if not is_reference(task)]
