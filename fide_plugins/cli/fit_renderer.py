"""`fide fit TARGET --renderer FILE.py:NAME` and ``--command '...'``: a renderer of one's own."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from fide_plugins.cli.arguments import (
    free_directory,
    function_of,
    optimizer_options,
    program_of,
    space_of,
)
from fide_plugins.cli.fit_inputs import pictures, value_range_of
from fide_plugins.cli.progress import page_of
from fide_plugins.cli.terminal import (
    USAGE_ERRORS,
    as_typed,
    continuation,
    duration,
    note,
    number,
    paragraph,
    plain,
    warnings_as_notes,
)
from fide_plugins.errors import FideError, ImageError, OptionError, RenderError
from fide_plugins.validation.options import positive_fraction

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE
    from fide_plugins.fitting.fitting import Fitting
    from fide_plugins.fitting.rendering import Outcome
    from fide_plugins.fitting.result import Result
    from fide_plugins.types import Float64, Solution

__all__ = ["OWN", "execute"]

OWN = (
    "space", "workers", "timeout", "mask", "weights", "time", "stop_at", "until", "until_stalled",
    "encoder", "learned", "max_failures", "value_range",
)  # fmt: skip
"""Arguments that no model has."""
_BUDGET = 2000
_MOST = 40  # parameters that are printed


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Execute the command; returns the exit code."""
    from fide_plugins.fitting.fitting import FitInterrupted
    from fide_plugins.recording.storage import is_saved

    who, args.optimizer = "fide fit", "fide"
    with warnings_as_notes(who):
        try:
            fitting, out, again = _prepare(args, command)
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
            with page_of(out) if args.live else nullcontext():
                result = fitting.execute()
            _keep_pictures(again, result, out)
        except FitInterrupted as stop:
            saved = f" after {stop.result.evaluations} renders, saved in {plain(out)}"
            unsaved = getattr(stop, "__notes__", ())  # what could not be written
            note(f"{who}: {stop}{saved}" if not unsaved else f"{who}: {stop}")
            for remark in unsaved:
                note(paragraph(remark))
            _note_found(stop.result)
            if (out / "summary.png").exists():
                note(f"look at {plain(out)}/summary.png")
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


Again: TypeAlias = "Callable[[FIDE, Float64], list[Outcome]]"
"""Renders points (n, dim) outside of the loop, as the fit renders them."""


def _prepare(args: argparse.Namespace, command: list[str]) -> tuple[Fitting, Path, Again]:
    """Everything checked, with one render; the run directory; and what renders further points."""
    from fide_plugins.cli.fit_inputs import check_first, outcomes
    from fide_plugins.fitting.one_call import prepare
    from fide_plugins.fitting.stopping import Stopping
    from fide_plugins.fitting.workers import default_number
    from fide_plugins.recording.storage import read_run

    render, space, timeout = _renderer(args)
    values = value_range_of(args.value_range)
    targets, mask, weights = pictures(
        args.targets, args.size, args.mask, args.weights, raw=values is not None
    )
    until = args.until or "solved"
    stalled = bool(args.until_stalled)
    share = args.max_failures
    endless = args.budget is None and (args.time is not None or stalled or until == "stalled")
    budget = None if endless else args.budget or _BUDGET
    workers = default_number() if args.workers is None else args.workers
    out = free_directory(args, Path(args.targets[0]).stem)

    def check(optimizer: FIDE) -> None:
        if read_run(out) is None:
            check_first(render, optimizer, targets, args.targets, workers, timeout)

    def again(optimizer: FIDE, X: Float64) -> list[Outcome]:
        return outcomes(render, optimizer, X, workers, timeout)

    fitting = prepare(
        render,
        targets[0] if len(targets) == 1 else targets,
        space,
        stopping=Stopping.of(budget, args.time, args.stop_at, until, stalled),
        workers=workers,
        seed=args.seed,
        timeout=timeout,
        options=_options(args) | _given(mask, weights, values),
        out=out,
        resume=args.resume,
        command=command,
        callbacks=_callbacks(args),
        progress=_progress(),
        check=check,
        max_failures=1.0 if share is None else positive_fraction("max_failures", share),
    )
    return fitting, out, again


def _renderer(args: argparse.Namespace) -> tuple[Any, Any, Any]:
    """The renderer, its space, and the time-out of a worker."""
    from fide_plugins.renderers.command import TIMEOUT
    from fide_plugins.validation.options import seconds_of

    space = space_of(args.space)
    if args.renderer is not None:
        return *function_of(args.renderer, space), args.timeout
    if len(args.templates) != len(args.targets):
        raise OptionError(
            f"{len(args.templates)} commands for {len(args.targets)} targets; give --command once "
            "for each target, in the same order"
        )
    templates = args.templates[0] if len(args.templates) == 1 else args.templates
    limit = TIMEOUT if args.timeout is None else seconds_of("timeout", args.timeout)
    # the program is stopped before its worker, so that its output is known
    of_worker = None if args.timeout is None or args.workers == 0 else limit + 5
    raw = args.value_range is not None
    return *program_of(templates, space, limit, raw), of_worker


def _options(args: argparse.Namespace) -> dict[str, Any]:
    """Options of the optimizer, but for those of pictures."""
    options = {"loss": args.loss, **optimizer_options(args)}
    for name in ("encoder", "learned"):
        if getattr(args, name) is not None:
            options[name] = getattr(args, name)
    return options


def _given(mask: Any, weights: Any, value_range: Any) -> dict[str, Any]:
    """Options of pictures, those that are given."""
    options = {"mask": mask, "weights": weights, "value_range": value_range}
    return {name: value for name, value in options.items() if value is not None}


def _callbacks(args: argparse.Namespace) -> list[Any]:
    """What --live needs; without it `fide watch` reads checkpoints."""
    from fide_plugins.watch import LiveFile

    return [LiveFile()] if args.live else []


def _keep_pictures(again: Again, result: Any, out: Path) -> None:
    """Render further solutions for `fide solutions`; those that fail stay without an image.

    Each is one render, which the budget does not count.  Those that are stored already stay.
    """
    import numpy as np

    from fide_plugins import solutions as stored
    from fide_plugins.fitting.pictures import canonical, picture
    from fide_plugins.fitting.rendering import Rendered

    known = stored.read_images(out)
    points = [one.x for one in result.solutions[1:]]
    new = [x for x in points if stored.image_of(known, x) is None]
    if not new:
        return
    for x, outcome in zip(new, again(result.optimizer, np.array(new)), strict=True):
        if isinstance(outcome, Rendered):
            with suppress(ImageError):  # no image that fits is a render that failed, too
                image = canonical(result.optimizer, outcome.image)
                known.append((x, picture(result.optimizer, image)))
    kept = [(x, image) for x, image in known if any(np.array_equal(x, one) for one in points)]
    if kept:
        stored.write_images(out, [x for x, _ in kept], [image for _, image in kept])


def _progress() -> Any:
    """A bar in a terminal, lines elsewhere."""
    import sys

    from fide_plugins.cli.progress import lines

    return True if sys.stderr.isatty() else lines("fide fit")


def _summary(result: Any, out: Path) -> dict[str, Any]:
    """Totals for JSON."""
    from fide_plugins.recording.record import SUMMARY
    from fide_plugins.recording.storage import read_run

    run = read_run(out)
    totals = {} if run is None else run["totals"]
    return {
        **{key: totals[key] for key in SUMMARY},
        "params": _as_data(result.params),
        "status": result.status.code,
        "stopped": result.stopped,
        "failures": result.failures,
        "clipped": result.clipped,
    }


def _as_data(params: Any) -> Any:
    return params.tolist() if hasattr(params, "tolist") else params


def _note_found(result: Result | None) -> None:
    """Say what a fit had found when it ended early."""
    if result is not None and result.best is not None:
        note(f"best loss {number(result.best.loss)}")
        for line in _parameters(result.best):
            note(line)


def _parameters(best: Solution) -> list[str]:
    """Lines with the parameters in their units."""
    from fide_plugins.recording.parameters import lines

    return [f"  {paragraph(line)}" for line in lines(best, _MOST)]


def _report(result: Result, out: Path) -> None:
    """Print the end of a fit: the status has the loss."""
    failed = f", {result.failures} renders failed" if result.failures else ""
    failed += f", {result.clipped} images clipped" if result.clipped else ""
    if result.rejected:
        failed += f", {result.rejected:.0%} of the candidates rejected by constraints"
    stopped = f"stopped: {result.stopped.replace('_', '-')}"
    print(f"{result.evaluations} renders in {duration(result.seconds)}, {stopped}{failed}")
    if result.best is None:
        print(_without_best(result))
        return
    print(plain(result.status))
    print("\n".join(_parameters(result.best)))
    if result.std_renders:
        print(f"± one standard deviation, from {result.std_renders} more renders around the answer")
    print(f"look at {plain(out)}/summary.png, or: {as_typed(['fide', 'solutions', str(out)])}")


def _without_best(result: Any) -> str:
    """Why a fit has no best candidate."""
    if result.evaluations:
        return "no render has a finite loss"
    if not result.failures:
        return "nothing was rendered in that time; give more --time"
    shown = "" if result.first_failure is None else "; the first error is printed above"
    return f"no render gave an image{shown}"
