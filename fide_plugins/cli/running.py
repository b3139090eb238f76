"""A run from the command line: messages and exit codes around the harness."""

from __future__ import annotations

import argparse
import json
import math
import shlex
import traceback
from collections.abc import Callable
from typing import Any

from fide_plugins.cli.messages import complain, duration, note, notices, number, plain
from fide_plugins.errors import FideError, RenderError

__all__ = ["USAGE_ERRORS", "execute_run"]

USAGE_ERRORS = (FideError, ValueError, TypeError, OSError, ImportError)
"""What can be wrong with the arguments or the installation, before anything is rendered."""


def execute_run(
    args: argparse.Namespace, command: list[str], prepare: Callable[[], Any], what: str
) -> int:
    """Prepare a harness.Run, execute it, report; returns the exit code."""
    from fide_plugins.cli.progress import reporting
    from fide_plugins.harness import Interrupted

    who = f"fide {command[1]}"
    try:
        with notices("fide_tasks"):
            run = prepare()
    except RenderError as error:
        note(f"{who}: the run failed: {plain(error)}")
        return 1
    except USAGE_ERRORS as error:
        return complain(who, error)
    out = plain(run.out)
    done = run.progress.evaluations
    if done:
        finished = done >= run.progress.budget
        note(f"{out} is finished" if finished else f"continuing {out} after {done} renders")
    try:
        with reporting(what) as report:
            result = run.execute(report)
    except Interrupted as stop:
        note(f"{who}: {stop} after {run.progress.evaluations} renders, saved in {out}")
        note(f"continue with: {_continuation(command, str(run.out))}")
        return 128 + stop.signum
    except (FideError, OSError) as error:
        note(f"{who}: the run failed: {plain(error)}")
        return 1
    except Exception:
        traceback.print_exc()
        note(f"{who}: the run failed; what it had found is in {out}")
        return 1
    if args.json:
        print(json.dumps(result.summary(), allow_nan=False), flush=True)
    else:
        _report(result, out)
    return 0


def _report(result: Any, out: str) -> None:
    parts = "  ".join(f"{part} {duration(s)}" for part, s in result.times.items() if s >= 0.05)
    mse = "" if result.loss == "mse" else f", MSE {number(result.mse)}"
    print(f"best {result.loss} {number(result.best_loss)}{mse} after {result.evaluations} renders")
    if result.reference_loss != result.best_loss and math.isfinite(result.reference_loss):
        print(
            f"without noise {number(result.reference_loss)}, "
            f"the recommended candidate {number(result.recommended_loss)}"
        )
    print(f"{duration(result.wall_s)}: {parts}")
    print(f"look at {out}/summary.png")


def _continuation(command: list[str], out: str) -> str:
    """The same command line, made to resume in `out`."""
    words = [word for word in command if word != "--resume"]
    if not any(word == "--out" or word.startswith("--out=") for word in words):
        words += ["--out", out]
    return plain(shlex.join([*words, "--resume"]))
