"""What a fit has found."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_plugins import encoders
from fide_plugins.errors import FideError, OptionError
from fide_plugins.fitting.pictures import best_compared, shown
from fide_plugins.recording.directory import is_of_a_run, results_in
from fide_plugins.recording.parameters import ROUGH, described, is_rough
from fide_plugins.recording.record import Record, best_so_far
from fide_plugins.recording.storage import RunDirectoryError, is_saved, read_run, with_optimizer
from fide_plugins.renderers import naming
from fide_plugins.runtime import checkpoint, laboratory
from fide_plugins.runtime.messages import cut

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fide_plugins.fide import FIDE
    from fide_plugins.fitting.rendering import Failed
    from fide_plugins.status import Status
    from fide_plugins.types import Float64, Indices, Solution


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """What a fit has found; `fide_plugins.load_run` reads one from a run directory.

    best: best candidate; None before the first image.
    params: what `render` got for it: a dictionary, or x (dim,) without a space; None without best.
    solutions: distinct candidates, best first, at most five; status: see `FIDE.status`.
    target: picture (H, W, 3) in [0, 1] or the range of values, a list of them for several views;
        weights: (H, W), which pixels count, likewise; None: all.
    curve: (n, 2), number of evaluations, 1 to n, and best loss by then; losses: (n,), of each
        evaluation, infinite before images began to be compared in another way; loss: its name.
    improved_at: (m,), evaluations, from 0, that were the best so far; path: (m, dim), their points
        in [0, 1].
    evaluations: images evaluated; failures: renders that gave none; clipped: images whose values
        went beyond black or white; seconds: of fitting; all with those before resuming.
    first_failure, rejected, busy: of this call, None or NaN of a result that was read: the first
        render that gave none; share of candidates that constraints rejected; share of the time of
        the search that its workers rendered.
    stopped: why it ended: "solved", "noise", "stalled" (see `fit`), "budget", "time", "stop_at",
        "callback", "interrupted" or "failed"; of a run that was read also "running", "finished".
    out: run directory; None without.
    optimizer: goes on where the fit has ended.
    cost: of all renders, in full ones, by pixels times samples; see `Fidelity`.
    plan: three lines on how a fit with a `time` was to spend it, by a renderer that takes `size`,
        `samples` or `seed`; else none.
    std_renders: renders around the answer, beside the evaluations, from which `best.std` is
        computed; 0: it is rough, from samples of the search, or was read.
    value_range: values of target and images that are black and white; None: 0 and 1.
    compared: best image as it is compared, where that is another picture than `best.image`.
    unsaved: what `save` calls, of a fit that has just ended.
    """

    best: Solution | None
    params: Any
    solutions: list[Solution]
    status: Status
    target: Any
    weights: Any
    curve: Float64
    losses: Float64
    loss: str
    improved_at: Indices
    path: Float64
    evaluations: int
    failures: int
    first_failure: Failed | None
    seconds: float
    busy: float
    stopped: str
    out: Path | None
    cost: float
    optimizer: FIDE
    std_renders: int = 0
    plan: tuple[str, ...] = ()
    clipped: int = 0
    value_range: tuple[float, float] | None = None
    unsaved: Callable[[str | os.PathLike[str]], None] | None = None
    rejected: float | None = None
    compared: Any = None

    @property
    def residual(self) -> Any:
        """What is left, (H, W) in [0, 1], see `FIDE.residual`."""
        return self.optimizer.residual

    def plot(self) -> Figure:
        """Figure of matplotlib: target, best image, difference (four times as strong), losses.

        Views are side by side.  `figure.savefig(path)` writes it.
        """
        figure: Figure = laboratory.module("figures").of_result(self)
        return figure

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the run directory that `out` would have written: of this moment of the fit.

        `load_run`, `fide solutions` and `resume=True` read it.  `plot().savefig` writes a picture.

        Raises FideError if `path` holds another run, or if the optimizer went on since; OSError.
        """
        if self.out is not None:
            to = Path(path)
            if (to / "run.json").exists() or results_in(to):
                raise RunDirectoryError(f"{to} holds a run already; name another directory")
            to.mkdir(parents=True, exist_ok=True)
            files = [file for file in self.out.iterdir() if is_of_a_run(file.name)]
            for file in sorted(files, key=lambda file: file.name == "run.json"):  # it last
                if file.is_file() and not file.is_symlink():
                    shutil.copyfile(file, to / file.name)
        elif self.unsaved is not None:
            self.unsaved(path)
        else:
            raise FideError("this result has neither a run directory nor an optimizer")

    @property
    def facts(self) -> str:
        """In one line: renders, seconds, why it ended, what failed."""
        facts = f"{self.evaluations:,} renders in {self.seconds:.1f} s"
        facts += f", as dear as {self.cost:,.0f} full ones" * (self.cost != self.evaluations)
        facts += f", stopped: {self.stopped}"
        facts += f", {self.failures:,} renders failed" * bool(self.failures)
        facts += f", {self.clipped:,} images clipped" * bool(self.clipped)
        rejected = f", {self.rejected or 0:.0%} of the candidates rejected by constraints"
        return facts + rejected * bool(self.rejected)

    def __repr__(self) -> str:
        loss = "none" if self.best is None else f"{self.best.loss:.6g}"
        params = f"dim={self.path.shape[1]}"
        if isinstance(self.params, dict) and self.best is not None:
            unnamed = self.best.space is None  # a task of a run that was read
            text = naming.described(self.params) if unnamed else described(self.best)
            rough = f" ({ROUGH})" if is_rough(self.best) and "±" in text else ""
            params = cut(text, 400) + rough
        lines = [
            f"Result(best loss {loss}; {self.facts}",
            f"params: {params}",
            f"solutions: {len(self.solutions)}",
            str(self.status),
        ]
        if self.value_range is not None:
            lines.append(f"value range: {self.value_range[0]:.6g} to {self.value_range[1]:.6g}")
        lines += [] if self.out is None else [f"out: {self.out}"]
        return "\n  ".join(lines) + ")"

    def _repr_html_(self) -> str:
        """HTML: status, pictures, and parameters in their units."""
        html: str = laboratory.module("figures").html_of(self)
        return html


def result_from(optimizer: FIDE, record: Record, solutions: list[Solution], **known: Any) -> Result:
    """Result of what an optimizer and the record of its run know; known: all else."""
    losses, adapts = np.array(record.losses, np.float64), optimizer.evaluator.comparison is not None
    compared = best_compared(optimizer) if adapts else None
    return Result(
        best=solutions[0] if solutions else None,
        solutions=solutions,
        status=optimizer.status,
        target=optimizer.target,
        weights=optimizer.weights,
        curve=np.stack([np.arange(1.0, len(losses) + 1), best_so_far(losses)], axis=1),
        losses=losses,
        loss=optimizer.evaluator.loss.name,
        improved_at=np.array(record.improvements, np.intp),
        path=np.array(record.path).reshape(len(record.path), optimizer.dim),
        evaluations=record.evaluations,
        seconds=record.wall_s,
        cost=record.cost,
        optimizer=optimizer,
        clipped=optimizer.clipped,
        value_range=optimizer.value_range,
        compared=None if compared is None else shown(optimizer, compared),
        **known,
    )


def opened(
    directory: str | os.PathLike[str], encoder: Callable[..., object] | None = None
) -> tuple[Path, dict[str, Any], FIDE]:
    """The folder of a run of FIDE, its `run.json`, and the optimizer; raises as `load_run`."""
    from fide_plugins.fide import FIDE

    path = Path(directory)
    run = read_run(path)
    if run is None:
        raise OptionError(f"{path} is no run directory; give one that fide fit or fide run wrote")
    if (name := run["settings"].get("optimizer")) != "fide":
        raise OptionError(
            f"{path} is a run of {name}, which keeps one solution: its best; only fide knows more"
        )
    if not is_saved(path):
        raise RunDirectoryError(
            f"{path} has no checkpoint, in which the result is; runs of a comparison keep none"
        )

    def load(file: Path) -> FIDE:
        settings: Any = checkpoint.read(file, "fide").get("settings")
        name = settings.get("encoder") if isinstance(settings, dict) else None
        own = isinstance(name, str) and name.partition(":")[0] not in encoders.names()
        if own and encoder is None:
            raise OptionError(
                f"{path} is a run with an encoder of your own, {name!r}; give it again: encoder=, "
                f"in the shell --encoder FILE.py:{name}"
            )
        return FIDE.load(file, encoder=encoder)

    return path, run, with_optimizer(path, load)
