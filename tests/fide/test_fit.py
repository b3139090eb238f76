"""What it is for: a picture is found in fewer renders than its losses alone allow."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fide_plugins.fide import FIDE
from fide_plugins.types import Float32

from .helpers import Render


def fit(target: Float32, render: Render, budget: int, **settings: Any) -> float:
    opt = FIDE(6, target, **settings)
    while opt.evaluations < budget:
        X = opt.ask()
        opt.tell(X, render(X))
    assert opt.best is not None
    return opt.best.loss


def test_ahead_of_cma_es_at_equal_renders(render: Render, target: Float32) -> None:
    """Six smooth parameters, 250 renders, every one of three seeds; a wide margin."""
    for seed in range(3):
        fide = fit(target, render, 250, seed=seed)
        cma_es = fit(target, render, 250, seed=seed, proposer="none")
        assert fide < 1e-5
        assert cma_es > 10 * fide


def test_the_disk_is_found_to_the_last_digits(render: Render, target: Float32) -> None:
    assert fit(target, render, 1500, seed=0) < 1e-8


def test_images_that_lie_do_not_stop_the_search(target: Float32) -> None:
    """Noise instead of renders: the losses alone still lead to the optimum."""
    rng = np.random.default_rng(0)

    opt = FIDE(6, target, seed=1)
    while opt.evaluations < 1500:
        X = opt.ask()
        losses = np.square(X - 0.3).sum(axis=1)
        opt.tell(X, rng.random((len(X), *target.shape), np.float32), losses)
    assert opt.best is not None
    assert opt.best.loss < 2e-3  # 0.24 at the center


@pytest.mark.parametrize("corner", [0.0, 1.0])
def test_an_answer_in_a_corner_of_the_box(corner: float, render: Render) -> None:
    answer = np.full((1, 6), corner)
    answer[0, 3:] = 1.0 - answer[0, 3:] if corner == 0.0 else answer[0, 3:]
    target = render(answer)[0]
    assert fit(target, render, 1200, seed=0) < 1e-5
