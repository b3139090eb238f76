r"""Compare optimizers with the same targets, budgets and seeds.

    fide compare voronoi --optimizers fide,cma,random --seeds 3 --budget 2000 --out runs/first
    fide compare voronoi spline --optimizers fide,cma,cma:popsize=50 --losses mse,perceptual \
        --seeds 10 --size 112 --jobs 2 --out runs/mine
    fide compare robot --optimizers fide,nevergrad:CMA,dibo:budget=2000 --out runs/robot --resume
    fide compare scene.py:render --optimizers fide,cma --seeds 5 --budget 1000 --out runs/scene
    fide compare --command 'povray scene.pov +O{out} Declare=Sun={sun}' --space space.toml \
        --target target.png --optimizers fide,cma --seeds 5 --budget 1000 --out runs/sun
    fide compare --suite image-fitting-v1 --optimizers fide,mine.py:Search --out runs/suite

An optimizer is NAME or NAME:KEY=VALUE:..., with its options; `budget` is one of them. NAME may be
FILE.py:NAME or module:NAME, a class of your own with ask and tell (docs/reference/compare.md). With
--resume the command executes the missing runs: after an interruption, or for more tasks, losses,
optimizers or seeds. At the end it writes the report, like `fide report`.
"""

from __future__ import annotations

import argparse
from typing import Any

from fide_lab.cli.arguments import (
    add_grid_arguments,
    add_own_task,
    add_suite_arguments,
    names,
    options_of,
    suite_plan,
    task_of,
    thresholds,
)
from fide_lab.cli.running import execute_all, execute_comparisons
from fide_plugins.cli.arguments import setting, whole
from fide_plugins.cli.terminal import note, plain
from fide_plugins.errors import OptionError

_SEEDS, _BUDGET, _SIZE = 10, 5000, 224
_METRICS = ("mse", "perceptual")
"""Losses that measure every improvement, in addition to those that are minimized."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fide compare``."""
    add = parser.add_argument
    add("tasks", nargs="*", metavar="TASK", help="see: fide list tasks; or FILE.py:NAME")
    add("--optimizers", type=names, default=["fide", "cma", "random"], metavar="A,B",
        help="see: fide list optimizers (fide,cma,random); or FILE.py:NAME")  # fmt: skip
    add("--losses", type=names, metavar="L,M", help="see: fide list losses (mse)")
    add("--size", type=whole(1), metavar="PX", help=f"side of the image ({_SIZE})")
    where = add_grid_arguments(parser, what="comparison", seeds=_SEEDS, budget=_BUDGET)
    where.add_argument("--dask", metavar="ADDRESS", help="scheduler of a Dask cluster")
    add("--set", type=setting, action="append", default=[], metavar="KEY=VALUE", dest="options",
        help="any option of all optimizers, such as popsize=50; may be repeated")  # fmt: skip
    add("--metrics", type=names, metavar="L,M",
        help="losses that measure every improvement "
        "(those minimized, mse and perceptual)")  # fmt: skip
    add("--threshold", type=thresholds, action="append", default=[], metavar="[TASK/]LOSS=VALUE",
        help="loss that counts as success, for the report; may be repeated")  # fmt: skip
    add_own_task(parser)
    add_suite_arguments(parser)
    parser.set_defaults(budget=None, seeds=None, losses=None, size=None)  # a suite has its own


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Execute the command; returns the exit code."""

    def run(comparison: Any) -> int:
        from fide_lab.cli.report_command import make

        code = _execute(comparison)
        return max(code, make(args.out, None, dict(args.threshold), "fide compare"))

    return execute_comparisons(args, command, lambda: _prepare(args, command), run)


def _prepare(args: argparse.Namespace, command: list[str]) -> Any:
    from fide_lab.compare import Plan
    from fide_lab.compare.driver import prepare

    if args.suite is not None:
        plan: Plan = suite_plan(args)
    else:
        for name in ("scenes", "targets"):
            if getattr(args, name) is not None:
                raise OptionError(f"--{name} is of a suite; add --suite NAME, or leave it out")
        plan = _plan(args)
        if args.threshold:
            from fide_lab.report.page import check_thresholds

            check_thresholds(dict(args.threshold), plan.runs())
    return prepare(
        plan, args.out, jobs=args.jobs, dask=args.dask, resume=args.resume, command=command
    )


def _plan(args: argparse.Namespace) -> Any:
    from fide_lab.compare import Configuration, Plan

    if args.template is None and not args.tasks:
        raise OptionError("name a TASK, or give --command or --suite; see: fide compare --help")
    losses = args.losses or ["mse"]
    metrics = args.metrics or list(dict.fromkeys([*losses, *_METRICS]))
    return Plan(
        tuple(args.tasks) if args.template is None else (task_of(args),),
        tuple(map(Configuration.parse, args.optimizers)), tuple(losses), args.seeds or _SEEDS,
        args.budget or _BUDGET, args.size or _SIZE, args.task_seed,
        dict(args.task_set) | options_of(args), dict(args.options), tuple(metrics),
    )  # fmt: skip


def _execute(comparison: Any) -> int:
    """Execute the comparison with one line for each run; returns 1 if a run failed, else 0."""
    for key, state in comparison.states.items():
        if state.why:
            note(f"{key} is {state.kind} and will be repeated: {plain(state.why)}")
        elif state.kind == "started":
            note(f"{key} will be continued")
    kept = sum(state.kind == "finished" for state in comparison.states.values())
    if kept:
        note(f"{kept} of {len(comparison.states)} runs are finished")
    return execute_all(comparison)
