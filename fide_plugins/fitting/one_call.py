"""`fit`: a renderer, a picture and a space in, the best parameters out."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from inspect import signature
from textwrap import shorten
from typing import Any

from fide_plugins.errors import ImageError, OptionError, RenderError
from fide_plugins.fide import FIDE
from fide_plugins.fitting.callbacks import Callbacks, check_progress
from fide_plugins.fitting.fidelity import Fidelity, schedule_for
from fide_plugins.fitting.fitting import Fitting
from fide_plugins.fitting.pictures import canonical
from fide_plugins.fitting.rendering import Rendered, Renderer, Workers
from fide_plugins.fitting.result import Result
from fide_plugins.fitting.saved_run import SavedRun, seed_there, settings_of
from fide_plugins.fitting.schedule import Schedule
from fide_plugins.fitting.stopping import Stopping
from fide_plugins.fitting.workers import default_number, gathered, workers_for
from fide_plugins.learning.posterior import with_model
from fide_plugins.options import check_known
from fide_plugins.recording.directory import of_files
from fide_plugins.recording.record import Record
from fide_plugins.recording.storage import is_saved
from fide_plugins.renderers.keywords import keywords_of
from fide_plugins.runtime.registry import fingerprint_of, own_name
from fide_plugins.space import Space
from fide_plugins.validation.options import check_names, positive_fraction, seconds_of, switch
from fide_plugins.validation.points import number_of_parameters, whole_number

_GIVEN = ("self", "dim", "target", "seed")  # arguments of the optimizer that the fit gives it


def fit(
    render: Callable[..., object],
    target: object,
    space: Space | int,
    budget: int | None = 2000,
    time: float | str | None = None,
    stop_at: float | None = None,
    workers: int | None = None,
    executor: object = None,
    views: Sequence[object] | None = None,
    mask: object = None,
    learned: object = None,
    callbacks: object = (),
    out: str | os.PathLike[str] | None = None,
    seed: int | None = None,
    *,
    constraints: Callable[[Any], object] | None = None,
    max_failures: float = 1.0,
    until: str = "solved",
    timeout: float | str | None = None,
    resume: bool = False,
    progress: object = None,
    value_range: object = None,
    fidelity: Fidelity | bool | None = None,
    **options: Any,
) -> Result:
    """Find the parameters whose image is the target.

    Parameters
    ----------
    render
        function of a dictionary of parameters, as `Space.decode` gives it, that returns an image of
        the target's size: any input of `FIDE.tell`.  Where `space` is a number, it gets x, float64
        (dim,) in [0, 1].
    target
        picture to find; or a list of them, one for each view: `render` then returns such a list.
    space
        parameters by name, or their number.
    budget
        images to evaluate at most; None: no limit.  Standard deviations may take up to a tenth
        more renders at the end, see `Result.std_renders`.
    time
        how long at most: seconds, or a text such as "10m" or "1h30m".
    stop_at
        loss at which to stop.
    workers
        renders at a time, in as many processes of their own, which are killed and replaced where
        they hang or die.  0: in this process, which costs least where a render takes milliseconds.
        None: one for each core, at most 8; with an `executor` of other than processes 8.  Where
        `render` cannot be pickled, threads take the place of processes, with a warning.
    executor
        where to render instead: "threads" (for a `render` that only waits, for a program or a
        server), any executor of `concurrent.futures`, or Dask's Client.
    views
        list of pictures of further views: the same as ``target=[target, *views]``.
    mask, learned
        options of `FIDE`.
    callbacks
        functions or objects that watch the fit or stop it, see `fide_plugins.fitting.callbacks`.
    out
        run directory: a checkpoint every few seconds, the curve, the best image.  None writes
        nothing.
    seed
        same seed, same fit, if there is one worker (0 or 1) and `render` is deterministic.  None
        draws one.
    constraints
        function of the parameters, as `render` gets them, that returns True where they are valid,
        or margins, <= 0 where they are valid.  Only valid ones are rendered.  Those of the space
        are respected, too.
    max_failures
        share of the last 50 renders that may fail, in (0, 1], see `fitting.failures`.
    until
        "solved": stop also when the image equals the target, or differs from it by noise of its
        pixels alone.  "stalled": stop also when nothing more is to be expected.  "budget": none of
        these.  See `fitting.stopping`.
    timeout
        seconds a render may take, or a text as for `time`; then its process is killed.  A thread
        cannot be killed: it is forgotten, and missing until it ends.
    resume
        go on with the fit in `out`, if there is one.  `budget`, `time`, `stop_at`, `workers` and
        the like may be others; what defines the fit must be the same.
    progress
        True: a bar; False: none; None: a bar in a terminal; or a function of a
        `recording.record.Progress`, which is called some ten times a second at most.
    value_range
        two numbers, the values of target and renders that are black and white, such as (0, 10), or
        "auto": from the target.  Images come back in these values; losses are of images scaled to
        [0, 1].
    fidelity
        how small, and of how few samples, renders may be: a `Fidelity`, for a `render` with
        keyword arguments size=(h, w), samples=n or seed=s.  None: few samples, at full size.
        False: always the finest.
    **options
        options of `FIDE`, such as `loss`, `encoder`, `preset`, `weights`, `x0`.

    A render that raises, takes too long, loses its process, or returns something else than an image
    of the right size is withdrawn and counted; the first one is shown whole, as a warning.

    Raises
    ------
    FideError
        before the first render: an option, the target or the space is not what it must be.
    FitError
        hardly any render succeeds, or a callback, the loss or the encoder raised an exception.
    ValueRangeError
        the renders are on another scale than the target.
    FitInterrupted
        (a KeyboardInterrupt) Ctrl-C or SIGTERM.
    OSError
        the run directory cannot be written.

    Whatever ends the fit after it has begun has the attribute `result`: what was computed by then.
    """
    until = "stalled" if options.pop("until_stalled", False) else until  # its name in 0.2
    check_known(options, "fit", [name for name in signature(fit).parameters if name != "options"])
    given = {
        "mask": mask, "learned": learned, "constraints": constraints, "value_range": value_range
    }  # fmt: skip
    options |= {name: value for name, value in given.items() if value is not None}
    return prepare(
        render,
        _with_views(target, views),
        space,
        stopping=Stopping.of(budget, time, stop_at, until),
        workers=workers,
        executor=executor,
        callbacks=callbacks,
        out=out,
        seed=seed,
        timeout=timeout,
        resume=resume,
        progress=progress,
        max_failures=positive_fraction("max_failures", max_failures),
        fidelity=fidelity,
        options=options,
    ).execute()


def prepare(
    render: Callable[..., object],
    target: object,
    space: Space | int,
    *,
    stopping: Stopping,
    workers: int | None = None,
    executor: object = None,
    callbacks: object = (),
    out: str | os.PathLike[str] | None = None,
    seed: int | None = None,
    timeout: float | str | None = None,
    resume: bool = False,
    progress: object = None,
    options: dict[str, Any] | None = None,
    checkpoint_every: float = 5.0,
    command: Sequence[str] | None = None,
    check_first: bool = False,
    max_failures: float = 1.0,
    fidelity: Fidelity | bool | None = None,
) -> Fitting:
    """Check the arguments, and make or resume a fit; at most one image is rendered.

    stopping: when it is over.  checkpoint_every: seconds between checkpoints.  command: to record.
    check_first: whether one image is rendered before anything is written, see `_check_first`.
    All else as for `fit`.
    """
    _check_render(render, named=isinstance(space, Space))
    if out == "" or (switch("resume", resume) and out is None):
        raise OptionError("resume=True needs the run directory, and its name: give out=DIR")
    check_progress(progress)
    limit = None if timeout is None else seconds_of("timeout", timeout)
    number = default_number(executor) if workers is None else whole_number("workers", workers, 0)
    watchers, options = Callbacks(callbacks), dict(options or {})
    check_names(options, _GIVEN, "is no option of the optimizer, but an argument of the fit")
    number_of_parameters("space", space.dim if isinstance(space, Space) else space)
    seed = seed_there(out) if seed is None and out is not None and resume else seed
    there = resume and out is not None and is_saved(out)
    optimizer = FIDE(space, target, seed=seed, **with_model(options, render, resumed=there))
    schedule = schedule_for(render, fidelity, optimizer)
    keywords = {} if schedule is None else schedule.finest()
    renderer = Renderer(render, optimizer.space, optimizer.value_range is not None, keywords)
    plan = _plan(render, optimizer, stopping, options, schedule)
    with ExitStack() as refused:
        pool = workers_for(renderer, number, executor, limit)
        refused.callback(pool.close)
        if check_first:
            _check_first(optimizer, pool, limit)
        saved = None if out is None else SavedRun(out, **plan, resume=resume, command=command)
        record = None if saved is None else saved.begin(optimizer)
        refused.pop_all()
    return Fitting(
        optimizer, renderer, pool, stopping, watchers, record or Record(), saved, plan,
        limit, progress, checkpoint_every, max_failures, schedule,
    )  # fmt: skip


def _check_first(optimizer: FIDE, pool: Workers, limit: float | None) -> None:
    """Render where the search begins, and check the image.

    Raises RenderError for an error that other parameters hardly mend, ImageError (a ValueError) for
    an image that `FIDE.tell` refuses.  Other failures are left to the search.
    """
    (outcome,) = gathered(pool, optimizer.state.search.mean[None], limit)
    try:
        if isinstance(outcome, Rendered):
            canonical(optimizer, outcome.image)
            return
    except ImageError as error:
        raise type(error)(f"the first render gave no image that fits: {error}") from error
    if outcome.broken:
        told = outcome.reason in outcome.details  # a traceback ends with the reason
        shown = outcome.details if told else f"{outcome.reason}\n{outcome.details}".rstrip()
        raise RenderError(f"the first render failed: {shown}")


def _plan(
    render: Callable[..., object],
    optimizer: FIDE,
    stopping: Stopping,
    options: dict[str, Any],
    schedule: Schedule | None,
) -> dict[str, Any]:
    name = own_name(render)
    settings = settings_of(name, optimizer, options)
    if schedule is not None:
        settings["fidelity"] = schedule.options
    sources = of_files({name: fingerprint_of(render)})
    return {"settings": settings, "limits": stopping.record(), "sources": sources}


def _check_render(render: object, named: bool) -> None:
    """Raise OptionError for a function that cannot be called with one argument."""
    if not callable(render):
        shape = getattr(render, "shape", None)
        got = f"an array of shape {tuple(shape)}" if shape else shorten(repr(render), 60)
        raise OptionError(
            f"render must be a function of the parameters, not {got}; the order is "
            "fit(render, target, space)"
        )
    try:
        form = signature(render, follow_wrapped=False)
    except (TypeError, ValueError):  # of some functions of C nobody knows it
        return
    needed = {name for name, default in keywords_of(render).items() if default is form.empty}
    try:
        form.bind(None, **dict.fromkeys(needed))
    except TypeError as error:
        what, adapted = "dictionary", "lambda p: render(**p)"
        if not named:
            what, adapted = "array", "lambda x: render(*x)"
        raise OptionError(
            f"fit calls render(params) with one {what}, and render{form} does not take it "
            f"({error}); {adapted} adapts it"
        ) from None


def _with_views(target: object, views: Sequence[object] | None) -> object:
    if views is None:
        return target
    if not isinstance(views, list | tuple) or isinstance(target, list | tuple):
        raise OptionError(
            f"views must be a list of pictures beside one target, not {shorten(repr(views), 60)}; "
            "write views=[side], or target=[front, side] alone"
        )
    return [target, *views]
