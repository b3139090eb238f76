"""Arguments that `fide compare` and `fide tradeoff` share."""

from __future__ import annotations

import argparse
import math
from typing import Any

from fide_plugins.cli.arguments import path, setting, whole

__all__ = ["add_grid_arguments", "thresholds"]


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
