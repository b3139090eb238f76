r"""Sweep options that trade speed for accuracy, and recommend a combination for a given time.

    fide tradeoff voronoi --out runs/front
    fide tradeoff voronoi spline --preset fast,balanced --popsize 15,40 --size 56,112 \
        --seeds 5 --budget 5000 --jobs 2 --out runs/mine
    fide tradeoff beads --preset balanced --spp 4,16,64 --out runs/samples --resume

The command runs every combination of the values with every seed. --epochs, --steps, --tokens and
--precision are options of the network, for presets that have one (paper). With --resume the command
executes the missing runs: after an interruption, or for more values. At the end it writes
tradeoff.md, tradeoff.csv and, for each task, the loss against seconds and against renders with the
Pareto front.
"""

from __future__ import annotations

import argparse
import json
from typing import Any

from fide_lab.cli.arguments import add_grid_arguments
from fide_lab.cli.running import execute_comparisons, execute_each
from fide_plugins.cli.arguments import names, whole
from fide_plugins.cli.terminal import note, plain

__all__ = ["add_arguments", "execute"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fide tradeoff``."""
    add = parser.add_argument
    add("tasks", nargs="+", metavar="TASK", help="see: fide list tasks")
    add("--preset", type=names, metavar="A,B", help="(fast,balanced,accurate,paper)")
    add("--popsize", type=wholes(4), metavar="K,L", help="candidates per generation (the preset's)")
    add("--encoder", type=names, metavar="A,B", help="see: fide list encoders (the preset's)")
    add("--epochs", type=wholes(1), metavar="N,M", help="training epochs per generation (4)")
    add("--steps", type=wholes(1), metavar="N,M", help="denoising steps (3)")
    add("--size", type=wholes(1), metavar="PX,PX", help="sides of built-in tasks' images (112)")
    add("--spp", type=wholes(1), metavar="N,M", help="samples per pixel, for tasks of Mitsuba")
    add("--loss", default="mse", metavar="NAME", help="see: fide list losses (mse)")
    add_grid_arguments(parser, what="sweep", seeds=3, budget=2000)
    add("--json", action="store_true", help="end with one line of JSON on standard output")


def wholes(minimum: int) -> Any:
    """Parser of an argument: whole numbers >= `minimum`, separated by commas."""
    one = whole(minimum)

    def parse(text: str) -> list[int]:
        return [one(word) for word in names(text)]

    return parse


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Execute the command; returns the exit code."""
    return execute_comparisons(
        args,
        command,
        lambda: _prepare(args, command),
        lambda comparisons: max(execute_each(comparisons), _write(args)),
    )


def _prepare(args: argparse.Namespace, command: list[str]) -> list[Any]:
    from fide_lab.compare.driver import prepare
    from fide_lab.sweep import OPTIONS, Grid

    options = {name: getattr(args, name) for name in OPTIONS}
    grid = Grid(
        tuple(args.tasks),
        {name: values for name, values in options.items() if values is not None},
        args.loss,
        args.seeds,
        args.budget,
        args.task_seed,
        dict(args.task_set),
    )
    grid.check(args.out)
    return [
        prepare(plan, args.out / name, jobs=args.jobs, resume=args.resume, command=command)
        for name, plan in grid.plans()
    ]


def _write(args: argparse.Namespace) -> int:
    """Write tables, figures and recommendations; returns the exit code."""
    from fide_lab.sweep import read, write_tables

    combinations = read(args.out)
    text = write_tables(args.out, combinations)
    if args.json:
        note(text)
        print(json.dumps(_summary(combinations), allow_nan=False), flush=True)
    else:
        print(text)
        print(f"look at {plain(args.out)}/tradeoff.md")
    return 0


def _summary(combinations: list[Any]) -> dict[str, Any]:
    """Recommended combination and its loss, by task and time."""
    from fide_lab.sweep import advice

    summary: dict[str, Any] = {}
    for task in dict.fromkeys(each.task for each in combinations):
        points = advice([each for each in combinations if each.task == task])
        summary[task] = {
            time: p and {"setting": p.combination.label, "loss": p.loss}
            for time, p in points.items()
        }
    return summary
