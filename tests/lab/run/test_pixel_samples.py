"""Samples per pixel rise when noise decides the order of a generation, and not before."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fide_lab.run.pixel_samples import PixelSamples
from fide_plugins.errors import LossError, OptionError

K = 12  # candidates a generation


def search(
    samples: PixelSamples, generations: int, spread: float, noise: Callable[[int], float]
) -> list[int]:
    """Numbers of samples of each generation; losses of so much spread, noise by their number."""
    rng, numbers = np.random.default_rng(0), []
    for _ in range(generations):
        numbers.append(samples.number)
        true, sigma = spread * rng.standard_normal(K), noise(samples.number)
        again = true[0] + sigma * rng.standard_normal() if samples.pair_due else None
        samples.note(true + sigma * rng.standard_normal(K), again)
    return numbers


def by_root(sigma: float) -> Callable[[int], float]:
    """Noise as of independent samples, `sigma` of a single one."""
    return lambda number: sigma / np.sqrt(number)


@pytest.mark.parametrize(("sigma", "last"), [(0.1, 1), (0.55, 4), (1.1, 16), (20.0, 64)])
def test_stops_where_noise_no_longer_decides(sigma: float, last: int) -> None:
    """Where sigma is 0.55, it is 0.55 of the spread of 12 at one sample, 0.30 at four."""
    assert search(PixelSamples(1, 64), 200, 1.0, by_root(sigma))[-1] == last


def test_knows_the_noise_and_the_spread() -> None:
    samples = PixelSamples(4, 64, tolerance=100.0)
    search(samples, 400, 3.0, lambda _: 1.0)
    assert samples.noise == pytest.approx(1.0, rel=0.5)  # of sixteen pairs
    assert samples.spread == pytest.approx(np.sqrt(10.0), rel=0.3)


def test_rises_as_the_population_narrows() -> None:
    samples = PixelSamples(1, 64)
    assert search(samples, 50, 10.0, by_root(1.0)) == [1] * 50
    numbers = search(samples, 60, 0.8, by_root(1.0))
    assert numbers == sorted(numbers)
    assert numbers[-1] == 16


def test_renders_one_of_so_many_candidates_twice() -> None:
    samples, pairs = PixelSamples(2, 4, every=30, tolerance=1e9), 0
    for i in range(100):
        assert samples.pair_due == (i > 0 and i % 3 == 0)  # 30 candidates are three generations
        pairs += samples.pair_due
        samples.note(np.arange(10.0), 0.5 if samples.pair_due else None)
    assert pairs == 33


def test_ends_at_the_most_and_asks_for_no_more_pairs() -> None:
    samples = PixelSamples(4, 10, every=1)
    rises = [samples.note(np.ones(K), float(i)) for i in range(40)]
    assert rises.index(True) == 7  # with the eighth pair
    assert sum(rises) == 1
    assert samples.number == 10
    assert not samples.pair_due


def test_the_number_stays_while_others_of_a_generation_follow() -> None:
    samples = PixelSamples(1, 64, every=1)
    for i in range(30):
        assert not samples.note(np.ones(K), float(i), more=True)
    assert samples.number == 1
    assert samples.note(np.ones(K), 1.0)
    assert samples.number == 4


def test_losses_that_are_not_finite_say_nothing() -> None:
    samples = PixelSamples(1, 64, every=1)
    for _ in range(20):
        samples.note([np.nan, 1.0, np.inf, 2.0], np.inf)
    assert (samples.noise, samples.spread, samples.number) == (None, None, 1)


def test_continues_where_its_state_was_taken() -> None:
    one, other = PixelSamples(1, 64), PixelSamples(1, 64)
    search(one, 40, 0.5, by_root(2.0))
    other.load_state_dict(one.state_dict())
    assert search(other, 40, 0.5, by_root(2.0)) == search(one, 40, 0.5, by_root(2.0))


@pytest.mark.parametrize(
    "options",
    [{"least": 0}, {"least": 5, "most": 4}, {"tolerance": 0.0}, {"tolerance": np.inf}],
)
def test_refuses_what_cannot_be(options: dict[str, float]) -> None:
    with pytest.raises(OptionError):
        PixelSamples(**options)  # type: ignore[arg-type]


def test_refuses_losses_that_are_none() -> None:
    samples = PixelSamples()
    with pytest.raises(LossError):
        samples.note(["a", "b"])
    assert samples.spread is None
