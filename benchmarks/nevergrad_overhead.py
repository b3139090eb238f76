"""What the Nevergrad adapter costs beyond FIDE itself, for docs/reference/nevergrad.md.

    OMP_NUM_THREADS=1 python benchmarks/nevergrad_overhead.py

CPU time of one trial (ask, and tell with a loss and an existing image): FIDE alone, one candidate
at a time; the same candidates through Nevergrad; a Nevergrad optimizer that only draws at random
(the cost of Nevergrad itself); and Nevergrad's CMA-ES on the loss.  Blocks of trials alternate, so
that other programs affect all of them alike.  The table shows the median and the minimum of all
blocks.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import nevergrad as ng
import numpy as np
from nevergrad.optimization import base

from fide_adapters.nevergrad import ParametrizedFIDE
from fide_plugins import FIDE

BLOCK = 50


class Nothing(base.Optimizer):  # type: ignore[misc]
    """Draws, and learns nothing."""

    def _internal_ask(self) -> Any:
        return self._rng.normal(size=self.dimension)


def block(trial: Callable[[], None]) -> float:
    """Milliseconds of a trial."""
    start = time.process_time()
    for _ in range(BLOCK):
        trial()
    return 1e3 * (time.process_time() - start) / BLOCK


def contenders(dim: int, size: int) -> dict[str, Callable[[], None]]:
    rng = np.random.default_rng(0)
    target = rng.random((size, size, 3)).astype(np.float32)
    images = rng.random((16, size, size, 3)).astype(np.float32)
    alone = FIDE(dim, target, seed=0)

    def in_nevergrad(kind: Any) -> Any:
        return kind(ng.p.Array(shape=(dim,), lower=0, upper=1), budget=None)

    adapter = in_nevergrad(ParametrizedFIDE(target=target, seed=0))
    others = {"Nevergrad alone": in_nevergrad(Nothing), "CMA": in_nevergrad(ng.optimizers.CMA)}
    count = {"alone": 0, "adapter": 0}

    def loss(x: np.ndarray[Any, Any]) -> float:
        return float(((x - 0.3) ** 2).sum())

    def trial_alone() -> None:
        X = alone.ask(1)
        count["alone"] += 1
        alone.tell(X, images[count["alone"] % 16][None], [loss(X[0])])

    def trial_adapter() -> None:
        candidate = adapter.ask()
        count["adapter"] += 1
        adapter.tell(candidate, loss(candidate.value), image=images[count["adapter"] % 16])

    def trial_of(other: Any) -> Callable[[], None]:
        def trial() -> None:
            candidate = other.ask()
            other.tell(candidate, loss(candidate.value))

        return trial

    trials = {"FIDE alone": trial_alone, "FIDE in Nevergrad": trial_adapter}
    return trials | {name: trial_of(other) for name, other in others.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dim", type=int, nargs="+", default=[6, 40, 200])
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--blocks", type=int, default=20)
    options = parser.parse_args()
    for dim in options.dim:
        trials = contenders(dim, options.size)
        times: dict[str, list[float]] = {name: [] for name in trials}
        for _ in range(options.blocks):
            for name, trial in trials.items():
                times[name].append(block(trial))
        for name, statistic in (("median", np.median), ("least", np.min)):
            ms = {trial: float(statistic(values[2:])) for trial, values in times.items()}
            beyond = ms["FIDE in Nevergrad"] - ms["FIDE alone"]
            row = "  ".join(f"{trial} {value:.3f}" for trial, value in ms.items())
            print(f"d = {dim:3d}, {name:6} ms: {row}  beyond FIDE {beyond:.3f}", flush=True)


if __name__ == "__main__":
    main()
