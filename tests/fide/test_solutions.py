"""`solutions`: what is said of where searches have ended."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fide_plugins.fide import FIDE
from fide_plugins.types import Float32, Float64

from .helpers import Render


def test_each_knows_which_evaluation_found_it(
    target: Float32, render: Render, tmp_path: Path
) -> None:
    """Not which candidate it was: results come in another order, and some were never asked."""
    rng, told = np.random.default_rng(0), []
    opt = FIDE(6, target, seed=0, popsize=8, patience=2, improvement=0.5)
    while len(opt.solutions()) < 4:
        X: Float64 = rng.permutation(np.concatenate([opt.ask(), rng.random((1, 6))]))
        opt.tell(X, render(X))
        told += list(X)
        assert opt.evaluations < 4000
    opt.save(tmp_path / "opt")
    for found in (opt.solutions(), FIDE.load(tmp_path / "opt").solutions()):
        for one in found:
            np.testing.assert_allclose(told[one.evaluation], one.x, atol=1e-6)
