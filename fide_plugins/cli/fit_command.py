"""Fit a picture of your own (PNG, JPEG, ... of any size) with a model that can draw it.

    fide fit photo.jpg --model voronoi --cells 60
    fide fit letter.png --model spline --control-points 6 --budget 8000

The picture is reduced until its longer side has --size pixels; what is transparent becomes white.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from fide_plugins.cli.arguments import (
    add_run_arguments,
    free_directory,
    optimizer_options,
    setting,
    whole,
)
from fide_plugins.errors import OptionError

__all__ = ["add_arguments", "execute"]

_COUNTS = {"voronoi": "cells", "spline": "control_points"}
"""Models, and the option of each that says how much it can draw."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fide fit``."""
    add = parser.add_argument
    add("image", metavar="IMAGE", help="picture to fit")
    add("--model", required=True, choices=_COUNTS, help="what draws it")
    add("--cells", type=whole(1), metavar="N", help="of voronoi (8)")
    add("--control-points", type=whole(2), metavar="N", help="of spline (7)")
    add("--model-set", type=setting, action="append", default=[], metavar="KEY=VALUE",
        help="any other option of the model")  # fmt: skip
    add_run_arguments(parser, size="longer side of the picture, at most")


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Run it; returns the exit code."""
    from fide_plugins import harness
    from fide_plugins.cli.running import execute_run

    stem = Path(args.image).stem

    def prepare() -> harness.Run:
        import fide_tasks
        from fide_plugins import images

        options = _model_options(args)
        picture = images.load(args.image, max_side=args.size)
        return harness.prepare(
            fide_tasks.make(args.model, target=picture, **options),
            args.optimizer,
            args.loss,
            args.budget,
            args.seed,
            task_options=options,
            options=optimizer_options(args),
            out=free_directory(args, f"{stem}-{args.model}"),
            resume=args.resume,
            command=command,
        )

    return execute_run(args, command, prepare, args.model)


def _model_options(args: argparse.Namespace) -> dict[str, Any]:
    """Options of the model; OptionError for one that belongs to another."""
    options = dict(args.model_set)
    for model, option in _COUNTS.items():
        value = getattr(args, option)
        if value is not None:
            if model != args.model:
                flag = "--" + option.replace("_", "-")
                raise OptionError(f"{flag} belongs to --model {model}, not {args.model}")
            options[option] = value
    return options
