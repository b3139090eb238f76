"""Executes runs and comparisons for the command line, with messages and exit codes."""

from __future__ import annotations

import argparse
import json
import logging
import math
import os
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from fide_plugins.cli.terminal import (
    USAGE_ERRORS,
    complain,
    continuation,
    note,
    number,
    paragraph,
    picture_in,
    plain,
    warnings_as_notes,
)
from fide_plugins.errors import DependencyError, FideError, RenderError
from fide_plugins.recording.parameters import lines
from fide_plugins.runtime.files import write_bytes
from fide_plugins.runtime.messages import duration

_MOST = 12  # parameters that are printed where a run is stopped


def execute_run(
    args: argparse.Namespace,
    command: list[str],
    prepare: Callable[[], Any],
    what: str,
    more: Callable[[Any, Any], dict[str, Any]] = lambda run, result: {},
) -> int:
    """Prepare a `Run`, execute it, and print the result; returns the exit code.

    more: further totals of a run and its result, for --json.
    """
    from fide_lab.run import Interrupted
    from fide_plugins.cli import progress

    def execute(run: Any) -> int:
        out, done = plain(run.out), run.progress.evaluations
        if done:
            finished = done >= run.progress.budget
            note(f"{out} is finished" if finished else f"continuing {out} after {done} renders")
        if not _resumable(run):
            name = plain(run.settings["optimizer"])
            note(f"{name} takes images, which a checkpoint does not hold: no --resume of this run")
        try:
            result = run.execute(progress.lines(what))
        except (Interrupted, FideError, OSError):
            raise
        except (Exception, SystemExit):  # code of a user may end by sys.exit
            note(paragraph(traceback.format_exc()))
            note(f"fide {command[1]}: the run failed; its results so far are in {out}")
            return 1
        if args.json:
            print(json.dumps(result.summary() | more(run, result), allow_nan=False), flush=True)
        else:
            _report(result, run.out)
        return 0

    def stopped(run: Any) -> tuple[str, str]:
        saved = [f" after {run.progress.evaluations} renders, saved in {plain(run.out)}"]
        best, space = run.record.best, getattr(run.task, "space", None)
        if best is not None:  # its parameters in their units
            named = best if isinstance(space, int | None) else replace(best, space=space)
            saved += [f"best loss {number(best.loss)}"]
            saved += [f"  {paragraph(line)}" for line in lines(named, _MOST)]
        return "\n".join(saved), continuation(command, str(run.out)) if _resumable(run) else ""

    return _execute(command, prepare, execute, stopped, "the run failed")


def execute_comparisons(
    args: argparse.Namespace,
    command: list[str],
    prepare: Callable[[], Any],
    execute: Callable[[Any], int],
) -> int:
    """Prepare comparisons, and execute them; returns the exit code.

    execute: executes what `prepare` gave, and returns the exit code.
    """
    # Before NumPy is loaded: one thread per process, so that seconds depend little on --jobs.
    os.environ.setdefault("OMP_NUM_THREADS", "1")

    def stopped(prepared: Any) -> tuple[str, str]:
        return f", everything is saved in {plain(args.out)}", continuation(command)

    return _execute(command, prepare, execute, stopped, "it stopped")


def execute_all(comparison: Any) -> int:
    """Execute a comparison, with a line for each run that ends; returns 1 if one failed."""
    total, done, failed = len(comparison.states), 0, 0

    def on_outcome(outcome: Any) -> None:
        nonlocal done, failed
        done += 1
        failed += outcome.kind == "failed"
        if outcome.kind != "kept":
            remark, totals = f" ({plain(outcome.note)})" if outcome.note else "", outcome.totals
            said = outcome.kind
            if totals is not None:
                cost = f"{totals['evaluations']} renders, {duration(totals['wall_s'])}"
                said = f"{number(totals['best_loss'])} after {cost}"
            note(f"[{done}/{total}] {outcome.key}: {said}{remark}")

    comparison.execute(on_outcome)
    if failed:
        note(f"{failed} of {total} runs failed; error.txt in their directories has the tracebacks")
    return int(failed > 0)


def _execute(
    command: list[str],
    prepare: Callable[[], Any],
    execute: Callable[[Any], int],
    stopped: Callable[[Any], tuple[str, str]],
    failed: str,
) -> int:
    """Prepare and execute; whatever goes wrong becomes messages and an exit code."""
    from fide_lab.run import Interrupted

    who = f"fide {command[1]}"
    try:
        with notices("fide_tasks"), warnings_as_notes(who):
            prepared = prepare()
    except RenderError as error:
        note(f"{who}: {failed}: {paragraph(error)}")
        return 1
    except USAGE_ERRORS as error:
        return complain(who, error)
    except SystemExit:  # of a user's constructor
        note(paragraph(traceback.format_exc()))
        note(f"{who}: {failed}")
        return 1
    try:
        with warnings_as_notes(who):
            return execute(prepared)
    except Interrupted as stop:
        saved, again = stopped(prepared)
        note(f"{who}: {stop}{saved}")
        if again:
            note(f"continue with: {again}")
        return 128 + stop.signum
    except BrokenPipeError:  # of standard output, when all is done
        raise
    except (FideError, OSError) as error:
        note(f"{who}: {failed}: {paragraph(error)}")
        return 1


@contextmanager
def notices(logger: str) -> Iterator[None]:
    """Within this block, print the messages of a logger to standard error."""
    log, handler = logging.getLogger(logger), logging.Handler(logging.INFO)
    handler.emit = lambda record: note(plain(record.getMessage()))  # type: ignore[method-assign]
    before = log.level, log.propagate
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    log.propagate = False
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(before[0])
        log.propagate = before[1]


def write_figure(who: str, path: Path, make: Callable[[], bytes]) -> Path | None:
    """Write a figure to `path`; None, with a note, without matplotlib, which is an extra."""
    try:
        write_bytes(path, make())
    except DependencyError as error:
        note(f"{who}: {path.name} is left out: {error}")
        return None
    return path


def _resumable(run: Any) -> bool:
    return bool(getattr(run.optimizer, "resumable", True))


def _report(result: Any, out: Path) -> None:
    parts = "  ".join(f"{part} {duration(s)}" for part, s in result.times.items() if s >= 0.05)
    mse = "" if result.loss == "mse" else f", MSE {number(result.mse)}"
    print(f"best {result.loss} {number(result.best_loss)}{mse} after {result.evaluations} renders")
    if "error" in result.judged:
        print(f"error {number(result.judged['error'])}, which no optimizer has seen")
    if result.reference_loss != result.best_loss and math.isfinite(result.reference_loss):
        print(
            f"without noise {number(result.reference_loss)}, "
            f"the recommended candidate {number(result.recommended_loss)}"
        )
    print(f"{duration(result.wall_s)}: {parts}" if parts else duration(result.wall_s))
    print(f"look at {picture_in(out)}")
    if result.status is not None:
        print(plain(result.status))
