"""The inverse step alone: uniform points, one training, samples for the target."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fide_lab.baselines.image_based import Inverse
from fide_plugins.errors import OptionError
from fide_plugins.types import Float32, Float64

ANSWER = np.array([[0.2, 0.7]])


def picture(X: Float64) -> Float32:
    """Two halves, as bright as the parameters say."""
    images: Float32 = np.repeat(X, 8 * 16 * 3, axis=1).astype(np.float32).reshape(-1, 16, 16, 3)
    return images


def test_it_learns_from_uniform_points_and_then_samples_the_answer() -> None:
    network = {"width": 16, "blocks": 1, "epochs": 40, "batch_size": 50}
    options: dict[str, Any] = {"encoder": "patch", "budget": 1000, "share": 0.6, **network}
    opt = Inverse(2, picture(ANSWER)[0], seed=0, **options)
    points = []
    while opt.evaluations < 1000:
        X = opt.ask()
        opt.tell(X, picture(X))
        points.append(X)
    X = np.concatenate(points)
    first, rest = X[:600], X[600:]
    np.testing.assert_allclose(first.mean(axis=0), 0.5, atol=0.05)
    np.testing.assert_allclose(first.std(axis=0), 12**-0.5, atol=0.03)
    np.testing.assert_allclose(np.median(rest, axis=0), ANSWER[0], atol=0.08)
    assert rest.std(axis=0).max() < 0.12
    assert opt.times["train"] > 0.0


@pytest.mark.parametrize("options", [{"share": 1.5}, {"budget": 0}, {"epochs": 0}], ids=str)
def test_options_out_of_range_are_named(options: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=next(iter(options))):
        Inverse(2, picture(ANSWER)[0], **options)
