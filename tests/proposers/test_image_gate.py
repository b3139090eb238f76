"""How far images steer the search: what their rank correlation and the ranks of proposals say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import spearmanr

from fide_plugins.options import Options
from fide_plugins.proposers.image_gate import ImageGate
from fide_plugins.types import Float64

TARGET = torch.zeros(2, 5)


def tokens_at(distances: Float64) -> torch.Tensor:
    """Tokens (n, 2, 5) so far from the target, in the first channel and in all."""
    tokens = torch.zeros(len(distances), 2, 5)
    tokens[:, 1, 0] = torch.from_numpy(np.sqrt(distances)).float()
    return tokens


@pytest.mark.parametrize("kinds", [1000, 3, 2])
def test_it_is_spearman_s_with_equal_values_too(kinds: int) -> None:
    rng = np.random.default_rng(kinds)
    for n in (2, 3, 10, 57):
        a, b = rng.integers(kinds, size=(2, n)) * 1.0
        if np.ptp(a) and np.ptp(b):
            gate = ImageGate(Options(), (None,))
            gate.note_images(tokens_at(a), TARGET, b)
            assert gate.agreement == pytest.approx(spearmanr(a, b).statistic, abs=1e-12)


@pytest.mark.parametrize("n", [6, 15, 100])
def test_shown_by_the_second_generation_where_nearer_is_better(n: int) -> None:
    rng = np.random.default_rng(n)
    gate = ImageGate(Options(), (None, 1))
    assert gate.strength == 0
    for generation in range(20):
        losses = rng.random(n)
        noisy = losses + 0.02 * rng.random(n)
        gate.note_images(tokens_at(noisy), TARGET, losses)
        assert gate.strength == 1 or generation < (2 if n < 10 else 0)


def test_by_chance_as_seldom_as_stated() -> None:
    """Noise in 300 runs of ten generations: shown at the end of 0.13 % of them."""
    rng = np.random.default_rng(0)
    sums, shown = [], 0
    for _ in range(300):
        gate = ImageGate(Options(), (None,))
        for _ in range(10):
            gate.note_images(tokens_at(rng.random(12)), TARGET, rng.random(12))
        sums.append(gate._sum / gate._variance**0.5)
        shown += gate.strength > 0
    assert np.std(sums) == pytest.approx(1.0, abs=0.15)
    assert shown <= 3  # 0.4 expected


@pytest.mark.parametrize("sign", [0.0, -1.0])
def test_not_shown_by_images_that_never_change_or_mislead(sign: float) -> None:
    gate = ImageGate(Options(), (None,))
    for seed in range(10):
        losses = np.random.default_rng(seed).random(20)
        gate.note_images(tokens_at(1.0 + sign * losses), TARGET, losses)
    assert gate.strength == 0


def test_old_generations_are_forgotten() -> None:
    """After some 160 candidates, though it stays certain that images once agreed."""
    rng = np.random.default_rng(0)
    gate = ImageGate(Options(), (None,))
    for _ in range(20):
        losses = rng.random(20)
        gate.note_images(tokens_at(losses), TARGET, losses)
    strength = []
    for _ in range(40):  # the renderer broke
        gate.note_images(tokens_at(rng.random(20)), TARGET, rng.random(20))
        strength.append(gate.strength)
    assert strength[1] == 1 and np.mean(strength[7:]) < 0.05 and not any(strength[-10:])


@pytest.mark.parametrize(
    ("rho", "low", "high"), [(0.1, 0.0, 0.05), (0.3, 0.2, 0.6), (0.6, 0.95, 1.0), (-0.5, 0.0, 0.0)]
)
def test_followed_in_proportion_to_how_much_they_agree(rho: float, low: float, high: float) -> None:
    """Of normal numbers with this correlation; beyond 0.4 wholly, below 0.2 not at all."""
    strength = []
    for seed in range(12):
        rng, gate = np.random.default_rng(seed), ImageGate(Options(), (None,))
        for generation in range(60):
            losses, other = rng.standard_normal((2, 15))
            distances = np.exp(rho * losses + np.sqrt(1 - rho**2) * other)
            gate.note_images(tokens_at(distances), TARGET, losses)
            if generation >= 20:
                strength.append(gate.strength)
    assert low <= np.mean(strength) <= high


def test_losses_that_are_all_equal_say_nothing() -> None:
    gate = ImageGate(Options(), (None,))
    losses = np.arange(20.0)
    gate.note_images(tokens_at(losses), TARGET, losses)
    before = gate.state_dict()
    gate.note_images(tokens_at(losses), TARGET, np.full(20, 3.0))
    gate.note_images(tokens_at(losses[:1]), TARGET, losses[:1])
    assert gate.state_dict() == before and gate.strength == 1


def test_channel_subsets_are_averaged() -> None:
    """Near in the first channel, anywhere in the others."""
    losses = np.arange(20.0)
    tokens = tokens_at(losses)
    tokens[:, 0, 4] = 1000 * torch.from_numpy(np.random.default_rng(0).random(20)).float()
    gates = [ImageGate(Options(), subsets) for subsets in ((1,), (None,), (1, None))]
    for gate in gates:
        gate.note_images(tokens, TARGET, losses)
    colors, everything, both = (gate._sum for gate in gates)
    assert colors == pytest.approx(20.0)
    assert both == pytest.approx((colors + everything) / 2)


def test_nothing_is_proposed_before_it_is_shown() -> None:
    losses = np.arange(20.0)
    rng = np.random.default_rng(0)
    gate, careless = (ImageGate(Options(guard_images=on), (None,)) for on in (True, False))
    before = rng.bit_generator.state
    assert gate.number(10, rng) == 0
    assert rng.bit_generator.state == before  # the run is that of a search without images
    assert careless.number(10, rng) == 3
    gate.note_images(tokens_at(losses), TARGET, losses)
    assert gate.number(10, rng) == 3 and not gate.guided
    for _ in range(18):
        gate.note_images(tokens_at(losses), TARGET, losses)
    assert not gate.guided, "misleading images may agree for a while"
    gate.note_images(tokens_at(losses), TARGET, losses)
    assert gate.guided


def test_half_the_agreement_half_the_proposals(monkeypatch: pytest.MonkeyPatch) -> None:
    """And then images do not say when a search is over."""
    monkeypatch.setattr(ImageGate, "strength", 0.5)
    options = Options(proposal_fraction=0.4)
    gate, rng = ImageGate(options, (None,)), np.random.default_rng(0)
    assert np.mean([gate.number(30, rng) for _ in range(2000)]) == pytest.approx(6, abs=0.05)
    assert not gate.guided


def adapt(losses: Float64, proposed: list[int], fraction: float = 0.5) -> float:
    mask = np.zeros(len(losses), bool)
    mask[proposed] = True
    gate = ImageGate(replace(Options(), proposal_fraction=fraction, fraction_rate=0.2), (None,))
    gate.note_ranks(losses, mask)
    return gate.fraction


def test_the_fraction_moves_by_the_rate_where_one_kind_is_ahead_throughout() -> None:
    """Then the mean ranks differ by k / 2."""
    losses = np.arange(8.0)
    assert adapt(losses, [0, 1, 2, 3]) == pytest.approx(0.7)
    assert adapt(losses, [4, 5, 6, 7]) == pytest.approx(0.3)
    assert adapt(losses, [0]) == pytest.approx(0.7)
    assert adapt(losses, [7]) == pytest.approx(0.3)


def test_the_fraction_stays_within_its_limits() -> None:
    fraction = 0.5
    for _ in range(50):
        fraction = adapt(np.arange(4.0), [3], fraction)
    assert fraction == 0.05
    for _ in range(50):
        fraction = adapt(np.arange(4.0), [0], fraction)
    assert fraction == 0.8


def test_failures_cost_a_proposer_as_much_as_the_worst_losses() -> None:
    losses = np.arange(10.0)
    worst = adapt(losses, [9])
    failed = adapt(np.where(losses == 9, np.inf, losses), [9])
    assert failed == pytest.approx(worst)
    tied = adapt(np.where(losses >= 8, np.inf, losses), [8, 9])
    assert tied == pytest.approx(adapt(losses, [8, 9]))


def test_images_of_a_known_picture_end_searches_as_soon_as_they_agree() -> None:
    rng = np.random.default_rng(4)
    known, other = ImageGate(Options(), (None,), known=True), ImageGate(Options(), (None,))
    assert not known.guided  # nothing was seen yet
    for generation in range(1, 25):
        losses = rng.random(12)
        for gate in (known, other):
            gate.note_images(tokens_at(losses), TARGET, losses)
        assert known.guided == (known.strength == 1.0)
        assert other.guided == (generation >= 20)
    assert known.guided
