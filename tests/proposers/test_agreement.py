"""Whether images agree with losses: a rank correlation, and what chance makes of it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.stats import spearmanr

from fide_plugins.points import Float64
from fide_plugins.presets import Options
from fide_plugins.proposers.agreement import Agreement, rank_correlation
from fide_plugins.proposers.trust import Trust

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
            assert rank_correlation(a, b) == pytest.approx(spearmanr(a, b).statistic, abs=1e-12)


def test_a_constant_correlates_with_nothing() -> None:
    assert rank_correlation(np.ones(5), np.arange(5.0)) == 0.0


def test_extreme_values_are_ranked_like_any_others() -> None:
    a = np.array([-1e300, -5e-324, 0.0, 1e-300, 1e308])
    assert rank_correlation(a, np.arange(5.0)) == pytest.approx(1.0)
    assert rank_correlation(a, -a) == pytest.approx(-1.0)


@pytest.mark.parametrize("n", [6, 15, 100])
def test_shown_by_the_second_generation_where_nearer_is_better(n: int) -> None:
    rng = np.random.default_rng(n)
    agreement = Agreement((None, 1))
    assert agreement.strength == 0
    for generation in range(20):
        losses = rng.random(n)
        noisy = losses + 0.02 * rng.random(n)
        agreement.note(tokens_at(noisy), TARGET, losses)
        assert agreement.strength == 1 or generation < (2 if n < 10 else 0)


def test_by_chance_as_seldom_as_stated() -> None:
    """Noise in 300 runs of ten generations: shown at the end of 0.13 % of them."""
    rng = np.random.default_rng(0)
    sums, shown = [], 0
    for _ in range(300):
        agreement = Agreement((None,))
        for _ in range(10):
            agreement.note(tokens_at(rng.random(12)), TARGET, rng.random(12))
        sums.append(agreement._sum / agreement._variance**0.5)
        shown += agreement.strength > 0
    assert np.std(sums) == pytest.approx(1.0, abs=0.15)
    assert shown <= 3  # 0.4 expected


@pytest.mark.parametrize("sign", [0.0, -1.0])
def test_not_shown_by_images_that_never_change_or_mislead(sign: float) -> None:
    agreement = Agreement((None,))
    for seed in range(10):
        losses = np.random.default_rng(seed).random(20)
        agreement.note(tokens_at(1.0 + sign * losses), TARGET, losses)
    assert agreement.strength == 0


def test_old_generations_are_forgotten() -> None:
    """After some 160 candidates, though it stays certain that images once agreed."""
    rng = np.random.default_rng(0)
    agreement = Agreement((None,))
    for _ in range(20):
        losses = rng.random(20)
        agreement.note(tokens_at(losses), TARGET, losses)
    strength = []
    for _ in range(40):  # the renderer broke
        agreement.note(tokens_at(rng.random(20)), TARGET, rng.random(20))
        strength.append(agreement.strength)
    assert strength[1] == 1 and np.mean(strength[7:]) < 0.05 and not any(strength[-10:])


@pytest.mark.parametrize(
    ("rho", "low", "high"), [(0.1, 0.0, 0.3), (0.3, 0.3, 0.7), (0.6, 0.95, 1.0), (-0.5, 0.0, 0.0)]
)
def test_followed_in_proportion_to_how_much_they_agree(rho: float, low: float, high: float) -> None:
    """Of normal numbers with this correlation; beyond 0.4 wholly, below 0.2 not at all."""
    rng = np.random.default_rng(0)
    agreement = Agreement((None,))
    strength = []
    for _ in range(60):
        losses, other = rng.standard_normal((2, 15))
        distances = np.exp(rho * losses + np.sqrt(1 - rho**2) * other)
        agreement.note(tokens_at(distances), TARGET, losses)
        strength.append(agreement.strength)
    assert low <= np.mean(strength[20:]) <= high


def test_losses_that_are_all_equal_say_nothing() -> None:
    agreement = Agreement((None,))
    losses = np.arange(20.0)
    agreement.note(tokens_at(losses), TARGET, losses)
    before = agreement.state_dict()
    agreement.note(tokens_at(losses), TARGET, np.full(20, 3.0))
    agreement.note(tokens_at(losses[:1]), TARGET, losses[:1])
    assert agreement.state_dict() == before and agreement.strength == 1


def test_views_are_averaged() -> None:
    """Near in the first channel, anywhere in the others."""
    losses = np.arange(20.0)
    tokens = tokens_at(losses)
    tokens[:, 0, 4] = 1000 * torch.from_numpy(np.random.default_rng(0).random(20)).float()
    agreements = [Agreement(views) for views in ((1,), (None,), (1, None))]
    for agreement in agreements:
        agreement.note(tokens, TARGET, losses)
    colors, everything, both = (agreement._sum for agreement in agreements)
    assert colors == pytest.approx(20.0)
    assert both == pytest.approx((colors + everything) / 2)


def test_nothing_is_proposed_before_it_is_shown() -> None:
    losses = np.arange(20.0)
    rng = np.random.default_rng(0)
    trust, careless = Trust(Options(), (None,)), Trust(Options(guard_images=False), (None,))
    before = rng.bit_generator.state
    assert trust.number(10, rng) == 0
    assert rng.bit_generator.state == before  # the run is that of a search without images
    assert careless.number(10, rng) == 3
    trust.note_images(tokens_at(losses), TARGET, losses)
    assert trust.number(10, rng) == 3 and trust.guided


def test_half_the_agreement_half_the_proposals(monkeypatch: pytest.MonkeyPatch) -> None:
    """And then images do not say when a search is over."""
    monkeypatch.setattr(Agreement, "strength", 0.5)
    trust, rng = Trust(Options(share=0.4), (None,)), np.random.default_rng(0)
    assert np.mean([trust.number(30, rng) for _ in range(2000)]) == pytest.approx(6, abs=0.05)
    assert not trust.guided


def test_state_goes_on() -> None:
    trust = Trust(Options(), (None,))
    losses = np.arange(20.0)
    trust.note_images(tokens_at(losses), TARGET, losses)
    trust.note_ranks(losses, losses < 5)
    copy = Trust(Options(), (None,))
    copy.load_state_dict(trust.state_dict())
    assert copy.state_dict() == trust.state_dict()
    assert copy.guided and copy.share == trust.share > 0.3
