r"""Sweep options that trade speed for accuracy.

    fide tradeoff voronoi --out runs/front
    fide tradeoff voronoi spline --preset fast,balanced --popsize 15,40 --size 56 \
        --seeds 5 --budget 5000 --jobs 2 --out runs/mine

The command runs every combination of the values with every seed. With --resume it executes the
missing runs: after an interruption, or for more values. At the end it writes tradeoff.md and, for
each task, the loss against seconds and against renders with the Pareto front. `fide report` shows
the same runs.
"""

from __future__ import annotations

import argparse
from typing import Any

from fide_lab.cli.arguments import add_grid_arguments, names
from fide_lab.cli.running import execute_all, execute_comparisons
from fide_plugins.cli.arguments import whole
from fide_plugins.cli.terminal import plain

_SWEPT = ("preset", "popsize", "encoder")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fide tradeoff``."""
    add = parser.add_argument
    add("tasks", nargs="+", metavar="TASK", help="see: fide list tasks; or FILE.py:NAME")
    add("--preset", type=names, metavar="A,B", help="(fast,balanced,accurate,paper)")
    add("--popsize", type=wholes, metavar="K,L", help="candidates per generation (the preset's)")
    add("--encoder", type=names, metavar="A,B", help="see: fide list encoders (the preset's)")
    add("--size", type=whole(1), default=112, metavar="PX", help="side of a task's image (112)")
    add("--loss", default="mse", metavar="NAME", help="see: fide list losses (mse)")
    add_grid_arguments(parser, what="sweep", seeds=3, budget=2000)


def wholes(text: str) -> list[int]:
    """Whole numbers >= 4, separated by commas."""
    return [whole(4)(word) for word in names(text)]


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Execute the command; returns the exit code."""
    return execute_comparisons(
        args,
        command,
        lambda: _prepare(args, command),
        lambda comparison: max(execute_all(comparison), _write(args)),
    )


def _prepare(args: argparse.Namespace, command: list[str]) -> Any:
    from fide_lab.compare import Plan
    from fide_lab.compare.driver import prepare
    from fide_lab.sweep import configurations

    options = {name: getattr(args, name) for name in _SWEPT if getattr(args, name) is not None}
    plan = Plan(
        tuple(args.tasks), configurations(options), (args.loss,), args.seeds, args.budget,
        args.size, args.task_seed, dict(args.task_set), metrics=(args.loss,),
    )  # fmt: skip
    return prepare(plan, args.out, jobs=args.jobs, resume=args.resume, command=command)


def _write(args: argparse.Namespace) -> int:
    """Write tables, figures and recommendations; returns the exit code."""
    from fide_lab import compare
    from fide_lab.sweep import combinations_of, write_tables

    print(write_tables(args.out, combinations_of(compare.read(args.out))))
    print(f"look at {plain(args.out)}/tradeoff.md")
    return 0
