"""Work, counted: a fifth more of it for the same result fails.

Seconds depend on the machine and on who else is there; what is counted here does not.  Where a
change does less, lower the number; where more work buys something, raise it and say what it buys.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from typing import Any, TypeAlias

import numpy as np
import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

import fide_tasks
from fide_plugins.fide import FIDE
from fide_plugins.proposers.diffusion import DiffusionProposer

Counted: TypeAlias = Callable[[Counter[str]], AbstractContextManager[None]]

BEGIN, END = 150, 600  # renders between which a run is watched; its buffers are full by then
MORE = 1.2

# For one candidate: calls of functions, Python's and C's; thousands of n^3 of eigendecompositions
# and of Cholesky's (n, n), while one search goes on; images that are encoded.
WORK: dict[str, dict[str, float]] = {
    "fast": {"calls": 119, "eigen": 4.3, "factors": 6.2, "images": 1},
    "balanced": {"calls": 129, "eigen": 4.3, "factors": 29, "images": 1},
    "accurate": {"calls": 129, "eigen": 4.3, "factors": 29, "images": 1},
}
# Million floating-point operations, as published at 112: of training, for an example and an epoch;
# of proposing, for a candidate.
TRAINING, PROPOSING = 82.36, 63.46


@cache
def work(counted_calls: Counted, preset: str, restarts: str | None) -> dict[str, float]:
    """Work for one candidate of a run of Voronoi, all but rendering; restarts: None, the preset's.

    When a search is over depends on the last digits, which differ between CPUs, and after that the
    regressions are small.  So what grows with their cube is counted with ``restarts="none"``.
    """
    count: Counter[str] = Counter()
    task = fide_tasks.make("voronoi", size=56, seed=0)
    own: dict[str, Any] = {} if restarts is None else {"restarts": restarts}
    opt = FIDE(task.dim, task.target, preset=preset, seed=0, device="cpu", **own)
    compute, eigh, factor = opt.encoder.compute, np.linalg.eigh, torch.linalg.cholesky_ex

    def counted_compute(batch: Any) -> Any:
        count["images"] += len(batch)
        return compute(batch)

    def counted_eigh(matrix: Any) -> Any:
        count["eigen"] += len(matrix) ** 3
        return eigh(matrix)

    def counted_factor(matrix: Any) -> Any:
        count["factors"] += len(matrix) ** 3
        return factor(matrix)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.linalg, "cholesky_ex", counted_factor)
        patch.setattr(opt.encoder, "compute", counted_compute)
        patch.setattr(np.linalg, "eigh", counted_eigh)
        began = 0
        while opt.evaluations < END:
            if opt.evaluations < BEGIN:
                count.clear()
                began = opt.evaluations
            with counted_calls(count):
                X = opt.ask()
            images = task.render(X)
            with counted_calls(count):
                opt.tell(X, images)
    n = opt.evaluations - began
    cubes = {name: count[name] / n / 1000 for name in ("eigen", "factors")}
    return {"calls": count["calls"] / n, "images": count["images"] / n, **cubes}


@pytest.mark.parametrize("what", ["calls", "eigen", "factors", "images"])
@pytest.mark.parametrize("preset", WORK)
def test_work_for_one_candidate(counted_calls: Counted, preset: str, what: str) -> None:
    restarts = "none" if what in ("eigen", "factors") else None
    found, stated = work(counted_calls, preset, restarts)[what], WORK[preset][what]
    assert found < MORE * stated, f"{preset} does {found:.4g} {what} a candidate, not {stated}"
    assert found > stated / MORE, f"{preset} does less {what}, {found:.4g}: lower the number"


@contextmanager
def operations() -> Iterator[FlopCounterMode]:
    """Count them; those of attention by its products, of whose kernel torch counts GPUs' only."""
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        yield counter


def test_work_of_the_network() -> None:
    proposer = DiffusionProposer(40, epochs=1)
    x, tokens = np.random.default_rng(0).random((50, 40)), torch.rand(50, 49, 768)
    with operations() as training:
        proposer.update(x, tokens, None, np.full(40, 0.1))
    with operations() as proposing:
        proposer.propose(x, tokens[0], x[0], np.full(40, 0.1))
    for counter, stated in ((training, TRAINING), (proposing, PROPOSING)):
        found = counter.get_total_flops() / 50 / 1e6
        assert stated / MORE < found < MORE * stated
