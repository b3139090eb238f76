"""Gradients of pixels, averaged where a parameter is seen."""

from __future__ import annotations

import numpy as np
import pytest

from fide_lab.baselines.sge import SGE
from fide_plugins.types import Float32, Float64

GRAYS = np.random.default_rng(1).random(64)


def stripes(X: Float64) -> Float32:
    """Columns (n, 4, 64, 3), each as gray as its parameter."""
    return np.broadcast_to(X[:, None, :, None], (len(X), 4, 64, 3)).astype(np.float32)


def fitted(**options: object) -> SGE:
    opt = SGE(64, stripes(GRAYS[None])[0], seed=0, budget=1000, **options)  # type: ignore[arg-type]
    while opt.evaluations < 1000:
        X = opt.ask()
        opt.tell(X, stripes(X))
    return opt


def test_each_of_many_parameters_has_the_gradient_of_its_own_pixels() -> None:
    own, shared = (np.abs(fitted(block=block).recommend() - GRAYS) for block in (1, 64))
    assert np.median(own) < 0.01 < 0.03 < np.median(shared)  # one primitive: the whole image


def test_a_primitive_is_where_its_parameters_change_the_image() -> None:
    opt = SGE(64, stripes(GRAYS[None])[0], seed=0, block=16, budget=1000)
    X = opt.ask(5)
    assert opt.measuring
    assert [np.flatnonzero(x - X[0])[[0, -1]].tolist() for x in X[1:]] == [
        [i, i + 15] for i in range(0, 64, 16)
    ]


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_supports_cost_their_share_of_the_renders(share: float) -> None:
    opt, measured = SGE(64, stripes(GRAYS[None])[0], seed=0, block=4, share=share), 0
    while opt.evaluations < 2000:
        X = opt.ask()
        measured += len(X) * opt.measuring
        opt.tell(X, stripes(X))
    assert abs(measured / opt.evaluations - share) < 0.1
