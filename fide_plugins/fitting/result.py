"""What a fit has found."""

from __future__ import annotations

from dataclasses import dataclass
from textwrap import shorten
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

    from fide_plugins.fide import FIDE
    from fide_plugins.fitting.failures import Failure
    from fide_plugins.status import Status
    from fide_plugins.types import Float64, Solution

__all__ = ["Result"]


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """What a fit has found.

    best: best candidate; None before the first image.
    params: what `render` got for it: a dictionary, or x (dim,) without a space; None without best.
    solutions: distinct candidates, best first, at most five; see `FIDE.solutions`.
    status: what is known of the run: a code and a sentence; see `FIDE.status`.
    curve: (n, 2), number of evaluations, 1 to n, and best loss by then.
    evaluations: images evaluated, those before resuming included.
    failures: renders that gave no image, likewise; first_failure: of this call.
    clipped: images whose values went beyond black or white, likewise.
    seconds: of fitting, likewise.
    busy: fraction of the time of this call's search that its workers rendered, in [0, 1].  It
        counts renders that gave an image, and nothing of what `preset="global"` does before the
        search.
    stopped: why it ended: "solved", "noise", "stalled" (see `fit`), "budget", "time", "stop_at",
        "callback", "interrupted" or "failed".
    out: run directory; None without.
    optimizer: goes on where the fit has ended, by ask and tell.
    """

    best: Solution | None
    params: Any
    solutions: list[Solution]
    status: Status
    curve: Float64
    evaluations: int
    failures: int
    first_failure: Failure | None
    seconds: float
    busy: float
    stopped: str
    out: Path | None
    optimizer: FIDE
    clipped: int = 0

    def __repr__(self) -> str:
        failed = f", {self.failures:,} renders failed" if self.failures else ""
        failed += f", {self.clipped:,} images clipped" if self.clipped else ""
        loss = "none" if self.best is None else f"{self.best.loss:.6g}"
        named = isinstance(self.params, dict)
        params = shorten(_rounded(self.params), 300) if named else f"dim={self.optimizer.dim}"
        lines = [
            f"Result(best loss {loss} after {self.evaluations:,} evaluations, "
            f"{self.seconds:.1f} s{failed}; stopped by {self.stopped}",
            f"  params: {params}",
            f"  solutions: {len(self.solutions)}",
            *_range_of(self.optimizer),
            f"  {self.status}" + ("" if self.out is None else f"\n  out: {self.out}"),
        ]
        return "\n".join(lines) + ")"


def _range_of(optimizer: FIDE) -> list[str]:
    """A line on the range of values, if there is one."""
    values = optimizer.value_range
    return [] if values is None else [f"  value range: {values[0]:.6g} to {values[1]:.6g}"]


def _rounded(value: Any) -> str:
    """Parameters as a text, numbers with five digits."""
    if isinstance(value, dict):
        return ", ".join(f"{name}={_rounded(one)}" for name, one in value.items())
    if isinstance(value, list):
        return f"[{', '.join(f'({_rounded(one)})' for one in value)}]"
    return f"{value:.5g}" if isinstance(value, float) else repr(value)
