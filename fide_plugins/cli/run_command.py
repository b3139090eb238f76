"""Fit a built-in task or a test of your own renderer, and write a run directory with the result.

    fide run voronoi --size 112 --budget 4000
    fide run spline --optimizer cma --set popsize=50 --out runs/mine
    fide run voronoi --task-set cells=12 --task-seed 3 --json
    fide run beads --size 112 --spp 16 --loss perceptual --task-set variant=llvm
    fide run san_miguel --size 112 --spp 16 --least-spp 1
    fide run scene.py:render --space space.toml --task-seed 3

TASK is a name, or FILE.py:NAME (or module:NAME) for a function of your own that maps parameters to
an image. Its target is the image of random parameters. To fit a picture, see: fide fit --help

The directory holds summary.png, best.png, curve.csv, run.json and the checkpoint for --resume.
"""

from __future__ import annotations

import argparse
from typing import Any

from fide_plugins.cli.arguments import (
    add_run_arguments,
    add_space_argument,
    free_directory,
    optimizer_options,
    setting,
    whole,
)

__all__ = ["add_arguments", "execute"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fide run``."""
    parser.add_argument("task", metavar="TASK", help="see: fide list tasks; or FILE.py:NAME")
    add_run_arguments(parser, size="side of the image")
    add = parser.add_argument
    add("--task-seed", type=whole(0), default=0, metavar="N", help="chooses the target (0)")
    add("--spp", type=whole(1), metavar="N", help="samples per pixel, for tasks of Mitsuba")
    add("--least-spp", type=whole(1), metavar="N",
        help="samples per pixel at first; they rise to --spp as noise requires")  # fmt: skip
    add("--workers", type=whole(1), metavar="N",
        help="processes that render, for tasks of Mitsuba (1)")  # fmt: skip
    add("--task-set", type=setting, action="append", default=[], metavar="KEY=VALUE",
        help="any option of the task, such as cells=12; may be repeated")  # fmt: skip
    add("--learned", metavar="MODEL", help="model of: fide learn")
    add_space_argument(parser)


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Execute the command; returns the exit code."""
    from fide_plugins.cli.running import execute_run
    from fide_plugins.experiments import run as harness

    def prepare() -> harness.Run:
        return harness.prepare(
            args.task,
            args.optimizer,
            args.loss,
            args.budget,
            args.seed,
            size=args.size,
            task_seed=args.task_seed,
            task_options=_task_options(args),
            options=_learned(args) | optimizer_options(args),
            out=free_directory(args, args.task),
            resume=args.resume,
            command=command,
        )

    return execute_run(args, command, prepare, args.task)


def _learned(args: argparse.Namespace) -> dict[str, Any]:
    return {} if args.learned is None else {"learned": args.learned}


def _task_options(args: argparse.Namespace) -> dict[str, Any]:
    """Options of the task from --task-set and from the flags that are options of tasks."""
    flags = {name: getattr(args, name) for name in ("spp", "least_spp", "workers", "space")}
    return {**{k: v for k, v in flags.items() if v is not None}, **dict(args.task_set)}
