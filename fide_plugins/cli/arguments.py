"""Arguments that commands share."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import Any

from fide_plugins.errors import OptionError
from fide_plugins.validation.options import parse_key_value


def whole(minimum: int) -> Any:
    """Parser of an argument: a whole number >= `minimum`."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = minimum - 1
        if value < minimum:
            raise argparse.ArgumentTypeError(f"a whole number >= {minimum}, not {text!r}")
        return value

    return parse


def path(text: str) -> Path:
    """Parser of an argument: a file or directory; an unset variable of the shell is none."""
    if not text.strip():
        raise argparse.ArgumentTypeError("a path, not an empty text (an unset variable?)")
    return Path(text)


def setting(text: str) -> tuple[str, Any]:
    """Parse ``key=value``; the value is a bool, int, float or str, whichever fits first."""
    try:
        return parse_key_value(text)
    except OptionError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def add_run_arguments(
    parser: argparse.ArgumentParser,
    *,
    size: str,
    optimizer: str | None = "fide",
    budget: int | None = 5000,
    side: int | None = 224,
    renders: str = "number of renders",
) -> None:
    """Add what `fide run` and `fide fit` share; optimizer, budget, side: defaults, if any."""
    add = parser.add_argument
    add("--optimizer", default=optimizer, metavar="NAME",
        help="see: fide list optimizers; or FILE.py:NAME")  # fmt: skip
    add("--loss", default="mse", metavar="NAME", help="see: fide list losses (mse)")
    add("--budget", type=whole(1), default=budget, metavar="N",
        help=f"{renders}{_shown(budget)}")  # fmt: skip
    add("--size", type=whole(1), default=side, metavar="PX", help=f"{size}{_shown(side)}")
    add("--seed", type=whole(0), default=0, metavar="N", help="seed of the optimizer (0)")
    add("--preset", metavar="NAME", help="preset of fide: fast, balanced, accurate, paper")
    add("--set", type=setting, action="append", default=[], metavar="KEY=VALUE", dest="options",
        help="any option of the optimizer, such as popsize=50; may be repeated")  # fmt: skip
    add("--out", type=path, metavar="DIR", help="run directory (a new one in runs/)")
    add("--resume", action="store_true", help="continue the run in that directory, if there is one")
    add("--json", action="store_true", help="end with one line of JSON on standard output")


def _shown(default: int | None) -> str:
    return "" if default is None else f" ({default})"


def add_space_argument(parser: Any) -> None:
    """Add --space, the parameters of a user's renderer."""
    parser.add_argument("--space", metavar="FILE.toml",
                        help="parameters of your renderer (the space beside it)")  # fmt: skip


def optimizer_options(args: argparse.Namespace) -> dict[str, Any]:
    """Options of the optimizer from --set and --preset."""
    preset = {} if args.preset is None else {"preset": args.preset}
    return {**preset, **dict(args.options)}


def free_directory(args: argparse.Namespace, what: str) -> Path:
    """Run directory: --out, or a new one in runs/; with --resume, the last one with its name."""
    if args.out is not None:
        return Path(args.out)
    name = f"{what}-{args.optimizer}-{args.loss}-seed{args.seed}"
    first = free = last = Path("runs", re.sub(r"[^A-Za-z0-9._-]+", "_", name).lstrip("."))
    for number in count(2):
        if not free.exists():
            break
        last, free = free, first.with_name(f"{first.name}-{number}")
    return last if args.resume else free


def own_renderer(
    args: argparse.Namespace, reference: str | None, templates: Sequence[str] | None, raw: bool
) -> tuple[Any, Any, Any] | None:
    """A user's own renderer, its space, and its time limit; None for a built-in task.

    templates: a command for each view, whose limit is in seconds.  raw: whether it has a range.
    """
    from fide_plugins.renderers import CommandRenderer, FunctionRenderer
    from fide_plugins.renderers.command import TIMEOUT
    from fide_plugins.runtime.registry import is_reference
    from fide_plugins.space import Space
    from fide_plugins.validation.options import seconds_of

    try:
        space = None if args.space is None else Space.read(args.space)
    except (FileNotFoundError, IsADirectoryError) as error:
        raise OptionError(
            f"--space: there is no file {args.space!r}; name the TOML file with a table for each "
            "parameter (docs/reference/space.md)"
        ) from error
    if templates:
        if space is None:
            raise OptionError("--command needs --space FILE.toml, the parameters and their ranges")
        limit = TIMEOUT if args.timeout is None else seconds_of("timeout", args.timeout)
        several = templates if len(templates) > 1 else templates[0]
        return CommandRenderer(several, space, limit, raw), space, limit
    if is_reference(str(reference)):
        function = FunctionRenderer(str(reference))
        return function, function.space_or(space), args.timeout
    if space is not None:
        raise OptionError(f"--space is for your own renderer; {reference} has its own space")
    return None
