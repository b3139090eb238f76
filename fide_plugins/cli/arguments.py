"""Arguments that commands share."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any

__all__ = ["add_run_arguments", "free_directory", "optimizer_options", "setting", "whole"]


def whole(minimum: int) -> Any:
    """Type of an argument that is a whole number >= `minimum`."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = minimum - 1
        if value < minimum:
            raise argparse.ArgumentTypeError(f"a whole number >= {minimum}, not {text!r}")
        return value

    return parse


def setting(text: str) -> tuple[str, Any]:
    """``key=value`` with the value as int, float, bool or str, whichever fits first."""
    key, equals, value = text.partition("=")
    if not equals or not key.isidentifier():
        raise argparse.ArgumentTypeError(f"key=value, not {text!r}")
    words: dict[str, Any] = {"true": True, "false": False}
    if value.lower() in words:
        return key, words[value.lower()]
    for kind in (int, float):
        try:
            return key, kind(value)
        except ValueError:
            continue
    return key, value


def add_run_arguments(parser: argparse.ArgumentParser, *, size: str) -> None:
    """Add what `fide run` and `fide fit` have in common; `size` explains --size."""
    add = parser.add_argument
    add("--optimizer", default="fide", metavar="NAME", help="see: fide list optimizers")
    add("--loss", default="mse", metavar="NAME", help="see: fide list losses")
    add("--budget", type=whole(1), default=5000, metavar="N", help="number of renders (5000)")
    add("--size", type=whole(1), default=224, metavar="PX", help=f"{size} (224)")
    add("--seed", type=whole(0), default=0, metavar="N", help="of the optimizer (0)")
    add("--preset", metavar="NAME", help="of fide: fast, balanced, accurate, paper")
    add("--set", type=setting, action="append", default=[], metavar="KEY=VALUE", dest="options",
        help="any option of the optimizer, such as popsize=50; may be repeated")  # fmt: skip
    add("--out", type=Path, metavar="DIR", help="run directory (a new one in runs/)")
    add("--resume", action="store_true", help="continue the run in that directory, if there is one")
    add("--json", action="store_true", help="end with one line of JSON on standard output")


def optimizer_options(args: argparse.Namespace) -> dict[str, Any]:
    """Options for the optimizer from --set and --preset."""
    preset = {} if args.preset is None else {"preset": args.preset}
    return {**preset, **dict(args.options)}


def free_directory(args: argparse.Namespace, what: str) -> Path:
    """Run directory: --out, or one in runs/ that says what it holds.

    Without --out a run never meets another one: its directory gets a number.  With --resume it is
    the last of that name.
    """
    if args.out is not None:
        return Path(args.out)
    name = f"{what}-{args.optimizer}-{args.loss}-seed{args.seed}"
    name = re.sub(r"[^A-Za-z0-9._-]+", "_", name).lstrip(".")
    number, last, path = 1, None, Path("runs", name)
    while path.exists():
        number, last = number + 1, path
        path = Path("runs", f"{name}-{number}")
    return last if args.resume and last is not None else path
