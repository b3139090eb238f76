"""Fit your own picture: with a renderer of your own, or with a model that draws it.

    fide fit target.png --renderer scene.py:render --space space.toml --workers 8 --out runs/scene
    fide fit target.png --command 'povray scene.pov +O{out} Declare=Sun={sun}' --space space.toml
    fide fit front.png side.png --renderer scene.py:render --time 10m --until stalled
    fide fit photo.jpg --model voronoi --cells 60

--renderer is FILE.py:NAME (or module:NAME), a function of a dictionary of parameters that returns
an image, or a list of images for several targets. The parameters are `space = Space(...)` in that
file, or --space. --command runs a program for each image, without a shell: {out} is the name of the
image that it writes, {NAME} a parameter, {NAME:.3f} the same in a format; {width} and {height} are
the target's, or smaller at first with --smallest; with {samples} a fit begins with few, and {seed}
is another one for each image. For several targets, give --command several times.

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
import json
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fide_plugins.cli.arguments import (
    add_run_arguments,
    add_space_argument,
    free_directory,
    optimizer_options,
    own_renderer,
    whole,
)
from fide_plugins.cli.progress import lines
from fide_plugins.cli.terminal import (
    USAGE_ERRORS,
    as_typed,
    complain,
    continuation,
    note,
    number,
    paragraph,
    picture_in,
    plain,
    warnings_as_notes,
)
from fide_plugins.errors import DependencyError, FideError, OptionError, RenderError
from fide_plugins.runtime import laboratory
from fide_plugins.validation.options import positive_fraction

if TYPE_CHECKING:
    from fide_plugins.fitting.fitting import Fitting
    from fide_plugins.fitting.result import Result
    from fide_plugins.types import Solution


_COMPARISON = ("photo", "photometric", "robust", "background")
_OF_MODELS = ("cells", "control_points", "model_set", "optimizer", "start")
"""Arguments that no renderer of a user has."""
_OF_RENDERERS = (
    "space", "workers", "timeout", "mask", "weights", "time", "stop_at", "until",
    "encoder", "learned", "max_failures", "value_range", "samples", "smallest", *_COMPARISON,
)  # fmt: skip
"""Arguments that no model has."""
_BUDGET = 2000
_MOST = 40  # parameters that are printed


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fide fit``."""
    add = parser.add_argument
    add("targets", nargs="+", metavar="TARGET", help="picture to fit, or one for each view")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--renderer", metavar="FILE.py:NAME", help="your function")
    what.add_argument("--command", action="append", metavar="'PROGRAM ...'", dest="templates",
                      help="your program; once for each target")  # fmt: skip
    what.add_argument(
        "--model", metavar="NAME", help="model that draws the picture: voronoi, spline"
    )
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
    add("--until", choices=("solved", "stalled", "budget"),
        help="stop also when solved, or when nothing more is to be expected; budget: by other "
        "limits alone (solved)")  # fmt: skip
    add("--samples", type=whole(1), metavar="N",
        help="most samples of a pixel, if it takes samples (its default, or 64)")  # fmt: skip
    add("--smallest", type=whole(1), metavar="PIXELS",
        help="begin with pictures of so many on the shorter side, if it takes a size")  # fmt: skip
    add("--max-failures", type=float, metavar="SHARE", help="of the last 50 renders (1: any)")
    add("--encoder", metavar="NAME", help="see: fide list encoders (the preset's)")
    add("--learned", metavar="MODEL", help="model of: fide learn")
    _add_comparison(add)
    if laboratory.is_installed():
        laboratory.module("cli.fit_model").add_arguments(parser)


def _add_comparison(add: Callable[..., object]) -> None:
    """Arguments for targets that the renderer did not draw."""
    add("--photo", action="store_true", default=None,
        help="not drawn by the renderer: light and clutter aside, coarse to fine")  # fmt: skip
    add("--photometric", choices=("exposure", "shading", "auto"),
        help="light that is set aside (none; with --photo auto)")  # fmt: skip
    add("--robust", nargs="?", const="auto", type=_scale, metavar="SCALE",
        help="differences beyond it count less: a number in (0, 1], or auto")  # fmt: skip
    add("--background", choices=("free",),
        help="what the render does not cover is explained by the target's colors")  # fmt: skip


def _scale(text: str) -> float | str:
    return text if text == "auto" else float(text)


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Execute the command; returns the exit code."""
    try:
        kind = "model" if args.model else "renderer" if args.renderer else "command"
        _refuse(args, _OF_RENDERERS if args.model else _OF_MODELS, f"--{kind}")
    except OptionError as error:
        return complain("fide fit", error)
    if not args.model:
        return _execute(args, command)
    try:
        fit_model = laboratory.module("cli.fit_model")
    except DependencyError as error:
        return complain("fide fit", f"--model: {error}")
    code: int = fit_model.execute(args, command)
    return code


def _refuse(args: argparse.Namespace, names: tuple[str, ...], given: str) -> None:
    """Raise OptionError for an argument that has no meaning beside `given`."""
    for name in names:
        if getattr(args, name, None) is not None:
            flag, remedy = "--" + name.replace("_", "-"), "leave it out"
            if name == "optimizer":
                remedy += "; to search with another one: fide run RENDERER --target PICTURE"
            raise OptionError(f"{flag} has no meaning with {given}; {remedy}")


def _execute(args: argparse.Namespace, command: list[str]) -> int:
    from fide_plugins.fitting.fitting import FitInterrupted
    from fide_plugins.recording.storage import is_saved

    who, args.optimizer = "fide fit", "fide"
    with warnings_as_notes(who):
        try:
            fitting, out = _prepare(args, command)
        except RenderError as error:
            note(f"{who}: {paragraph(error)}")
            return 1
        except USAGE_ERRORS as error:
            note(f"{who}: {paragraph(error)}")
            return 2
        if args.value_range == ["auto"]:
            low, high = fitting.optimizer.value_range or (0.0, 1.0)
            note(f"value range {low:.6g} to {high:.6g}, from the target")
        if fitting.record.evaluations:
            note(f"continuing {plain(out)} after {fitting.record.evaluations} renders")
        try:
            live = laboratory.module("cli.watch_command").page_of if args.live else nullcontext
            with live(out):
                result = fitting.execute()
            if laboratory.is_installed():
                laboratory.module("solutions").keep_pictures(fitting, args.workers, result, out)
        except FitInterrupted as stop:
            saved = [f" after {stop.result.evaluations} renders, saved in {plain(out)}"]
            unsaved = [f"\n{paragraph(one)}" for one in getattr(stop, "__notes__", ())]
            note("".join([f"{who}: {stop}", *(unsaved or saved)]))
            _note_found(stop.result)
            note(f"look at {picture_in(out)}")
            if is_saved(out):
                note(f"continue with: {continuation(command, str(out))}")
            return 128 + stop.signum
        except (FideError, OSError) as error:
            note(f"{who}: the run failed: {paragraph(error)}")
            _note_found(getattr(error, "result", None))  # perhaps no file could be written
            return 1
    if args.json:
        print(json.dumps(_summary(result, out), allow_nan=False), flush=True)
    else:
        _report(result, out)
    return 0


def _prepare(args: argparse.Namespace, command: list[str]) -> tuple[Fitting, Path]:
    """Everything checked, with one render; and the run directory."""
    from fide_plugins.cli.fit_inputs import pictures, value_range_of
    from fide_plugins.fitting.fidelity import Fidelity
    from fide_plugins.fitting.one_call import prepare
    from fide_plugins.fitting.stopping import Stopping
    from fide_plugins.fitting.workers import default_number
    from fide_plugins.recording.storage import read_run

    render, space, timeout = _renderer(args)
    values = value_range_of(args.value_range)
    targets, weights = pictures(
        args.targets, args.size, args.mask, args.weights, raw=values is not None
    )
    options = {"loss": args.loss, **optimizer_options(args)}
    given = {name: getattr(args, name) for name in ("encoder", "learned", *_COMPARISON)}
    given["value_range"] = values
    if any(one is not None for one in weights):
        given["weights"] = weights[0] if len(weights) == 1 else weights
    options |= {name: value for name, value in given.items() if value is not None}
    until, share = args.until or "solved", args.max_failures
    endless = args.budget is None and (args.time is not None or until == "stalled")
    budget = None if endless else args.budget or _BUDGET
    workers = default_number() if args.workers is None else args.workers
    out = free_directory(args, Path(args.targets[0]).stem)
    share = 1.0 if share is None else positive_fraction("max_failures", share)
    fidelity = None
    if args.samples is not None or args.smallest is not None:
        sizes = None if args.smallest is None else (args.smallest, 2**16)
        fidelity = Fidelity(sizes, (1, args.samples or 64))
    fitting = prepare(
        render,
        targets[0] if len(targets) == 1 else targets,
        space,
        stopping=Stopping.of(budget, args.time, args.stop_at, until),
        workers=workers,
        seed=args.seed,
        timeout=timeout,
        options=options,
        out=out,
        resume=args.resume,
        command=command,
        progress=True if sys.stderr.isatty() else lines("fide fit"),
        check_first=read_run(out) is None,
        fidelity=fidelity,
        max_failures=share,
    )
    return fitting, out


def _renderer(args: argparse.Namespace) -> tuple[Any, Any, Any]:
    """The renderer, its space, and the time-out of a worker."""
    if args.templates and len(args.templates) != len(args.targets):
        raise OptionError(
            f"{len(args.templates)} commands for {len(args.targets)} targets; give --command once "
            "for each target, in the same order"
        )
    found = own_renderer(args, args.renderer, args.templates, args.value_range is not None)
    if found is None:
        raise OptionError(f"no renderer {args.renderer!r}; write FILE.py:NAME")
    if args.templates is None:
        return found
    # the program is stopped before its worker, so that its output is known
    limit = None if args.timeout is None or args.workers == 0 else found[2] + 5
    return *found[:2], limit


def _summary(result: Any, out: Path) -> dict[str, Any]:
    """Totals for JSON."""
    from fide_plugins.recording.record import SUMMARY
    from fide_plugins.recording.storage import read_run

    run = read_run(out)
    totals = {} if run is None else run["totals"]
    return {
        **{key: totals[key] for key in SUMMARY},
        "params": result.params.tolist() if hasattr(result.params, "tolist") else result.params,
        "status": result.status.code,
        "stopped": result.stopped,
        "failures": result.failures,
        "cost": result.cost,
        "clipped": result.clipped,
    }


def _note_found(result: Result | None) -> None:
    """Say what a fit had found when it ended early."""
    if result is not None and result.best is not None:
        note(f"best loss {number(result.best.loss)}\n{_parameters(result.best)}")


def _parameters(best: Solution) -> str:
    """Lines with the parameters in their units."""
    from fide_plugins.recording.parameters import lines

    return "\n".join(f"  {paragraph(line)}" for line in lines(best, _MOST))


def _report(result: Result, out: Path) -> None:
    """Print the end of a fit: the status has the loss."""
    print(result.facts)
    if result.best is None:
        print("there is no image with a finite loss; fide check looks at the renderer")
        return
    print(plain(result.status))
    print(_parameters(result.best))
    if result.std_renders:
        print(f"± one standard deviation, from {result.std_renders} more renders around the answer")
    print(f"look at {picture_in(out)}, or: {as_typed(['fide', 'solutions', str(out)])}")
