"""The inverse predictor alone: where two answers make one image it finds both."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from fide_lab.baselines.image_based import PosteriorSampler
from fide_plugins.errors import OptionError

Floats = NDArray[np.float64]


def unordered(x: Floats) -> Tensor:
    """Two numbers of which the image shows which are there, not in which order; (n, 1, 2)."""
    return torch.as_tensor(np.sort(x, axis=1), dtype=torch.float32)[:, None]


def trained(n: int = 2400, epochs: int = 9, seed: int = 0) -> PosteriorSampler:
    x = np.random.default_rng(seed).random((n, 2))
    predictor = PosteriorSampler(2, seed=seed, epochs=epochs, batch_size=100, width=24, blocks=2)
    predictor.update(x, unordered(x))
    predictor.update(x, unordered(x), epochs=max(1, epochs // 2), learning_rate=2e-4)
    return predictor


@pytest.mark.thorough
def test_samples_find_both_answers_and_the_regression_their_average() -> None:
    predictor = trained()
    low, high = 0.2, 0.8
    image = unordered(np.array([[low, high]]))[0]
    x = predictor.sample(400, image)
    at = [np.abs(x - answer).max(axis=1) < 0.15 for answer in ([low, high], [high, low])]
    first, second = (float(near.mean()) for near in at)
    assert first + second > 0.8  # a uniform draw: 0.18
    assert 0.3 < first / (first + second) < 0.7  # a fair coin; five standard deviations are 0.13
    regression = predictor.regress(image)
    np.testing.assert_allclose(regression, 0.5, atol=0.1)

    def loss(proposed: Floats) -> Floats:
        wrong = unordered(proposed) - image
        return wrong.square().mean(dim=(1, 2)).double().numpy()

    assert np.median(loss(x)) < 0.05 * loss(regression[None])[0]


def test_samples_lie_in_the_unit_cube_and_repeat_with_the_seed() -> None:
    image = unordered(np.array([[0.0, 1.0]]))[0]
    first, again, other = (trained(200, 1, seed).sample(50, image) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert first.min() >= 0
    assert first.max() <= 1


def test_a_state_before_training_is_put_back_whole() -> None:
    fresh, used = (PosteriorSampler(2, epochs=1, width=24, blocks=1) for _ in range(2))
    before = fresh.state_dict()
    x = np.random.default_rng(0).random((50, 2))
    used.update(x, 5 + 3 * unordered(x))
    used.load_state_dict(before)
    assert used.state_dict()["scale"] is None
    image = unordered(np.array([[0.2, 0.8]]))[0]
    np.testing.assert_array_equal(used.sample(9, image), fresh.sample(9, image))


def test_channels_that_never_vary_do_no_harm() -> None:
    x = np.random.default_rng(0).random((50, 2))
    tokens = torch.cat([unordered(x), torch.ones(50, 1, 3)], dim=2)
    predictor = PosteriorSampler(2, epochs=1, width=8, blocks=1)
    assert bool(predictor.update(x, tokens).isfinite().all())
    assert np.isfinite(predictor.sample(5, tokens[0])).all()


def test_the_proposer_is_as_it_was_after_a_training_that_raises_and_after_samples() -> None:
    x = np.random.default_rng(0).random((50, 2))
    predictor = PosteriorSampler(2, epochs=3, width=8, blocks=1)
    proposer = predictor.proposer
    before = proposer.epochs, proposer.learning_rate, proposer.schedule
    predictor.fit(x, unordered(x), epochs=1)
    with pytest.raises(OptionError, match="image tokens keep the shape"):
        predictor.fit(x, torch.zeros(50, 3, 2), epochs=8)
    predictor.sample(5, unordered(x)[0])
    assert (proposer.epochs, proposer.learning_rate, proposer.schedule) == before


def test_at_least_one_step() -> None:
    with pytest.raises(OptionError, match="steps"):
        PosteriorSampler(2, steps=0)
