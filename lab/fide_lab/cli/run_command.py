r"""Fit a built-in task or a test of your own renderer, and write a run directory with the result.

    fide run voronoi --size 112 --budget 4000
    fide run spline --optimizer cma --set popsize=50 --out runs/mine
    fide run voronoi --task-set cells=12 --task-seed 3 --json
    fide run beads --size 112 --spp 16 --loss perceptual --task-set variant=llvm
    fide run san_miguel --size 112 --spp 4
    fide run scene.py:render --space space.toml --task-seed 3
    fide run --command 'povray scene.pov +O{out} Declare=Sun={sun}' --space space.toml

TASK is a name, or FILE.py:NAME (or module:NAME) for a function of your own that maps parameters to
an image; --command is a program of your own. The target is the image of random parameters, or
--target. To fit a picture with many workers, see: fide fit --help

The directory holds summary.png, best.png, curve.csv, run.json and the checkpoint for --resume.
"""

from __future__ import annotations

import argparse
from typing import Any

from fide_lab.cli.arguments import add_own_task, options_of, task_of
from fide_plugins.cli.arguments import (
    add_run_arguments,
    free_directory,
    optimizer_options,
    setting,
    whole,
)
from fide_plugins.cli.terminal import complain
from fide_plugins.errors import OptionError

_SIZE = 224


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fide run``."""
    parser.add_argument("task", nargs="?", metavar="TASK",
                        help="see: fide list tasks; or FILE.py:NAME")  # fmt: skip
    add_run_arguments(parser, size=f"side of the image ({_SIZE})", side=None)
    add = parser.add_argument
    add("--task-seed", type=whole(0), default=0, metavar="N", help="chooses the target (0)")
    add("--spp", type=whole(1), metavar="N", help="samples per pixel, for tasks of Mitsuba")
    add("--task-set", type=setting, action="append", default=[], metavar="KEY=VALUE",
        help="any option of the task, such as cells=12; may be repeated")  # fmt: skip
    add("--suite", metavar="NAME", help="TASK is a problem of this suite, such as wall-0")
    add("--learned", metavar="MODEL", help="model of: fide learn")
    add_own_task(parser)


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Execute the command; returns the exit code."""
    from fide_lab import run as harness
    from fide_lab.cli.running import execute_run

    try:
        task = _task(args)
    except OptionError as error:
        return complain("fide run", error)

    learned = {} if args.learned is None else {"learned": args.learned}

    def prepare() -> harness.Run:
        return harness.prepare(
            task, args.optimizer, args.loss, args.budget, args.seed, size=args.size or _SIZE,
            task_seed=args.task_seed, task_options=_task_options(args),
            options=learned | optimizer_options(args), out=free_directory(args, task),
            resume=args.resume, command=command,
        )  # fmt: skip

    return execute_run(args, command, prepare, task)


def _task(args: argparse.Namespace) -> str:
    if args.template is None and args.task is None:
        raise OptionError("name a TASK, or give --command; see: fide run --help")
    return task_of(args) if args.task is None or args.template is not None else str(args.task)


def _task_options(args: argparse.Namespace) -> dict[str, Any]:
    """Options of the task from --task-set and from the flags that are options of tasks."""
    flags = {name: getattr(args, name) for name in ("spp", "suite")}
    given = {k: v for k, v in flags.items() if v is not None} | options_of(args)
    return {**given, **dict(args.task_set)}
