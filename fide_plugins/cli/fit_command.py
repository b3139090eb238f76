r"""Fit your own picture: with a renderer of your own, or with a model that draws it.

    fide fit target.png --renderer scene.py:render --space space.toml --workers 8 --out runs/scene
    fide fit target.png --command 'povray scene.pov +O{out} Declare=Sun={sun}' --space space.toml
    fide fit front.png side.png --renderer scene.py:render --time 10m --until stalled
    fide fit photo.jpg --model voronoi --cells 60

--renderer is FILE.py:NAME (or module:NAME), a function of a dictionary of parameters that returns
an image, or a list of images for several targets. The parameters are `space = Space(...)` in that
file, or --space. --command runs a program for each image, without a shell: {out} is the name of the
image that it writes, {NAME} a parameter, {NAME:.3f} the same in a format. For several targets, give
--command several times.

Several targets are views of one scene: give --mask once for each, too, or once for all if they have
one size. --live opens a page in the browser that shows how far the fit is; `fide watch DIR` does so
for a fit that runs already.

With --resume and a larger --budget or --time a finished fit goes on. There is more in
docs/reference/own_renderer.md.

With --model, FIDE begins near parameters that are read off the picture: cells at its superpixels, a
stroke through its dark pixels. --start center begins at the center of the box.
"""

from __future__ import annotations

import argparse

from fide_plugins.cli import fit_renderer
from fide_plugins.cli.arguments import add_run_arguments, add_space_argument, setting, whole
from fide_plugins.cli.messages import as_typed, complain
from fide_plugins.errors import DependencyError, OptionError
from fide_plugins.runtime import laboratory

__all__ = ["MODELS", "add_arguments", "execute"]

MODELS = {"voronoi": "cells", "spline": "control_points"}
"""Models, and the option of each that sets its number of elements."""
_OF_MODELS = ("cells", "control_points", "model_set", "optimizer", "start")
"""Arguments that no renderer of a user has."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fide fit``."""
    add = parser.add_argument
    add("targets", nargs="+", metavar="TARGET", help="picture to fit, or one for each view")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--renderer", metavar="FILE.py:NAME", help="your function")
    what.add_argument("--command", action="append", metavar="'PROGRAM ...'", dest="templates",
                      help="your program; once for each target")  # fmt: skip
    what.add_argument("--model", choices=MODELS, help="model that draws the picture")
    add_run_arguments(
        parser,
        size="longer side of the picture, at most (as it is; with --model 224)",
        optimizer=None,
        budget=None,
        renders="number of renders (2000; with --model 5000; with --time or --until stalled: any)",
        side=None,
    )

    parser.add_argument("--live", action="store_true", help="watch the fit in the browser")
    own = parser.add_argument_group("your renderer")
    add_space_argument(own)
    add = own.add_argument
    add("--workers", type=whole(0), metavar="N", help="renders at a time (one a core, at most 8)")
    add("--timeout", metavar="TIME",
        help="of a render with all its views: 60, 2m (none; for --command 60)")  # fmt: skip
    add("--mask", action="append", metavar="FILE",
        help="picture: white counts, black does not; alpha: that of the target")  # fmt: skip
    add("--weights", action="append", metavar="FILE", help="picture: the brighter, the more")
    add("--value-range", nargs="+", metavar="LOW HIGH",
        help="values that are black and white: 0 10, or auto, from the target (0 1)")  # fmt: skip
    add("--time", metavar="TIME", help="how long at most: 90s, 10m, 1h30m")
    add("--stop-at", type=float, metavar="LOSS", help="loss at which to stop")
    until = own.add_mutually_exclusive_group()
    until.add_argument("--until", choices=("solved", "stalled", "budget"),
        help="stop also when solved, or when nothing more is to be expected; budget: by other "
        "limits alone (solved)")  # fmt: skip
    until.add_argument("--until-stalled", action="store_true", default=None,
        help="former name of --until stalled")  # fmt: skip
    add("--max-failures", type=float, metavar="SHARE", help="of the last 50 renders (1: any)")
    add("--encoder", metavar="NAME", help="see: fide list encoders (the preset's)")
    add("--learned", metavar="MODEL", help="model of: fide learn")

    model = parser.add_argument_group("a model that draws")
    add = model.add_argument
    add("--cells", type=whole(1), metavar="N", help="number of cells of voronoi (8)")
    add("--control-points", type=whole(2), metavar="N", help="number of points of spline (7)")
    add("--model-set", type=setting, action="append", metavar="KEY=VALUE",
        help="any other option of the model")  # fmt: skip
    add("--start", choices=("picture", "center"),
        help="where fide begins (picture; other optimizers: center)")  # fmt: skip


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Execute the command; returns the exit code."""
    try:
        _refuse(args, fit_renderer.OWN if args.model else _OF_MODELS, f"--{_kind(args)}")
    except OptionError as error:
        return complain("fide fit", error)
    if args.model:
        try:
            fit_model = laboratory.module("cli.fit_model")
        except DependencyError as error:
            return complain("fide fit", f"--model: {error}")
        code: int = fit_model.execute(args, command)
        return code
    return fit_renderer.execute(args, command)


def _kind(args: argparse.Namespace) -> str:
    return "model" if args.model else "renderer" if args.renderer else "command"


def _refuse(args: argparse.Namespace, names: tuple[str, ...], given: str) -> None:
    """Raise OptionError for an argument that has no meaning beside `given`."""
    for name in names:
        if getattr(args, name) is not None:
            flag = "--" + name.replace("_", "-")
            remedy = _by_run(args) if name == "optimizer" else "leave it out"
            raise OptionError(f"{flag} has no meaning with {given}; {remedy}")


def _by_run(args: argparse.Namespace) -> str:
    """The command that fits the same picture with another optimizer."""
    if len(args.targets) > 1 or args.optimizer == "fide" or not laboratory.is_installed():
        return "leave it out, since fide fit searches with fide"
    what = [args.renderer] if args.renderer else ["--command", args.templates[0]]
    space = [] if args.space is None else ["--space", args.space]
    words = ["fide", "run", *what, *space, "--target", args.targets[0]]
    return f"to search with another one: {as_typed([*words, '--optimizer', args.optimizer])}"
