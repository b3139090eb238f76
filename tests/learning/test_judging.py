"""A trained network is calibrated, measured and described on held-out renders."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from fide_plugins.learning import Model, learn
from fide_plugins.learning.judging import (
    LARGEST_SCALE,
    Familiarity,
    Report,
    are_shown,
    fitted_scale,
    scores,
    split_held_out,
)
from fide_plugins.learning.networks import Components, Network, as_input
from fide_plugins.space import Float, Space
from fide_plugins.types import Float64, Indices
from tests.learning.conftest import SIDE

KINDS: list[list[list[int]]] = [[], [[0, 1], [2, 3]]]
PERIODIC = (False, True, False, True, False)
PICTURE = np.full((1, SIDE, SIDE, 3), 100, np.uint8)


def network(blocks: list[list[int]]) -> Network:
    made = Network((SIDE, SIDE), PERIODIC, blocks, seed=3)
    made.eval()
    return made


def drawn(of: Network, n: int, seed: int = 0) -> Tensor:
    return of.sample(as_input(PICTURE), n, torch.Generator().manual_seed(seed))


def narrow(of: Network, to: float) -> None:
    """Make all standard deviations about `to`."""
    heads = [of.head, of.head.rest] if of.blocks else [of.head]
    z = np.log(to / 2e-3) / np.log(1 / 2e-3)  # of an axis that does not wrap around
    with torch.no_grad():
        for head in heads:
            for name, weight in head.named_parameters():
                if name in {"out", "out.weight", "layers.2.weight"}:
                    weight *= 0.0
                if name in {"out_bias", "out.bias", "layers.2.bias"}:
                    numbers = weight.view(-1, 4)  # weight, two of the mean, standard deviation
                    numbers[:, 3] = float(np.log(z / (1 - z))) - 1.0


@pytest.mark.thorough
@pytest.mark.parametrize("blocks", KINDS)
def test_the_scale_that_was_lost_is_found(blocks: list[list[int]]) -> None:
    """Parameters come from a density; one that is half as wide is mended."""
    true = network(blocks)
    narrow(true, 0.03)
    u = drawn(true, 120).numpy().astype(np.float64)
    images = np.repeat(PICTURE, len(u), axis=0)
    sure = network(blocks)
    narrow(sure, 0.015)
    found = fitted_scale(sure, u, images)
    on_a_circle = 2 ** (np.log(0.5 / 2e-3) / np.log(1 / 2e-3))  # 1.85
    assert on_a_circle * 0.8 < found < 2 * 1.2  # 120 renders tell it to 5 %
    assert sure.scale == 1.0  # as it was
    assert fitted_scale(true, u, images) == pytest.approx(1.0, abs=0.2)
    narrow(sure, 0.06)
    assert fitted_scale(sure, u, images) == 1.0  # never narrower


def test_the_scale_has_an_end() -> None:
    sure = network([])
    narrow(sure, 0.003)
    u = np.random.default_rng(0).random((60, 5))
    assert fitted_scale(sure, u, np.repeat(PICTURE, 60, axis=0)) == LARGEST_SCALE


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("scale", [0.25, 1.5, 4.0])
def test_a_widened_density_integrates_to_one(periodic: bool, scale: float) -> None:
    raw = torch.randn(40, 1, 3, 4, generator=torch.Generator().manual_seed(0))
    found = Components.of(raw, torch.tensor([periodic]), scale)
    missing = 0.03 if periodic else 1e-3  # the fourth turn of the widest Gaussian is left out
    u = ((torch.arange(20_000) + 0.5) / 20_000)[:, None, None]
    for i in range(40):
        one = Components(found.weight[i], found.mean[i], found.std[i], found.periodic)
        assert float(one.log_mixture(u).exp().mean()) == pytest.approx(1.0, abs=missing)


def test_renders_that_choose_do_not_judge() -> None:
    aside = np.arange(5000) % 50 == 0
    fit, judges = split_held_out(aside)
    assert (fit.sum(), judges.sum()) == (50, 50)
    assert [some.sum() for some in split_held_out(np.ones(2000, bool))] == [300, 1700]
    np.testing.assert_array_equal(fit | judges, aside)
    assert not (fit & judges).any()
    fit, judges = split_held_out(np.arange(4900) % 50 == 0)  # 98: too few
    assert not fit.any() and judges.sum() == 98
    assert fitted_scale(network([]), np.zeros((0, 5)), PICTURE[:0]) == 1.0


@pytest.mark.thorough
def test_the_scale_comes_with_the_file(tmp_path: Path) -> None:
    def gray(x: Any) -> Any:
        return np.broadcast_to(x[0], (SIDE, SIDE))

    learned = learn(gray, 2, renders=5000, size=SIDE, passes=1)
    assert (learned.report.fitted, learned.report.held_out) == (50, 100)
    assert learned.report.scale == learned.network.scale
    assert "calibrated: standard deviations times" in str(learned.report)
    learned.network.scale = 1.3
    model = replace(learned, report=replace(learned.report, scale=1.3))
    model.save(tmp_path / "m")
    again = Model.load(tmp_path / "m")
    assert again.network.scale == 1.3
    assert again.report == model.report
    picture = gray([0.4])
    np.testing.assert_array_equal(again.sample(picture, 8), model.sample(picture, 8))


def features(rng: np.random.Generator, n: int, spread: float = 0.2) -> Float64:
    """Of n renders (n, 30), some of them further away than normal ones would be."""
    z = rng.standard_normal((n, 30)) * np.linspace(1, 0.05, 30)
    return np.asarray(z * np.exp(spread * rng.standard_normal((n, 1))), np.float64)


@pytest.mark.parametrize("held_out", [2, 3, 5, 10, 20, 100])
def test_further_renders_are_familiar_however_few_were_held_out(held_out: int) -> None:
    """And other pictures are not: two of a hundred are the fewest that `learn` holds out."""
    unknown, known = [], []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        familiarity = Familiarity.of(features(rng, 49 * held_out), features(rng, held_out))
        unknown.append((familiarity.distances(features(rng, 100)) > familiarity.threshold).mean())
        others = features(rng, 100) + 1.0
        known.append((familiarity.distances(others) <= familiarity.threshold).mean())
    assert np.mean(unknown) < 0.005  # by the largest of ten alone, 0.017
    # by the held-out renders alone, 0.9 with two, 0.2 with five; of two a single fit may know all
    assert np.mean(known) < (0.05 if held_out == 2 else 0.005)


@pytest.mark.parametrize("held_out", [1, 2, 3])
def test_the_bound_is_finite_for_the_least_held_out_renders(held_out: int) -> None:
    rng = np.random.default_rng(0)
    same = np.full((4, 3), 0.5)
    for renders in (features(rng, held_out), np.zeros((held_out, 30))):
        assert np.isfinite(Familiarity.of(features(rng, 40), renders).threshold)
    familiarity = Familiarity.of(same, same[:held_out])
    known, unknown = familiarity.distances(np.stack([same[0], same[0] + 0.1]))
    assert known <= familiarity.threshold < unknown


NONE: Indices = np.empty((0, 0), np.intp)
TWO: Indices = np.array([[1, 2], [3, 4]])


def scored(rng: np.random.Generator, known: list[float], blocks: Indices) -> Float64:
    """Scores (60, d) of samples with these errors; 1: they say nothing of the truth, but surely.

    The blocks of samples come in another order than those of the truth in every second image.
    """
    found = []
    for i in range(60):
        truth = rng.random(len(known))
        where = np.where(np.array(known) < 1, truth, rng.random(len(known)))
        spread = np.where(np.array(known) < 1, known, 0.05)
        samples = np.clip(where + spread * rng.standard_normal((99, len(known))), 0, 1)
        if blocks.size and i % 2:
            samples[:, blocks] = samples[:, blocks[::-1]]
        found.append(scores(samples, truth, blocks))
    return np.array(found)


@pytest.mark.parametrize("hidden", [True, False])
def test_exchangeable_blocks_are_judged_together(hidden: bool) -> None:
    unknown = 1.0 if hidden else 0.05
    told = scored(np.random.default_rng(1), [1, 0.05, unknown, 0.05, unknown], TWO)
    shown = are_shown(told, ["level", "l.x", "l.y", "l.x", "l.y"])
    assert shown.tolist() == [False, True, not hidden, True, not hidden]


def test_a_model_that_is_sure_and_wrong_shows_nothing() -> None:
    told = scored(np.random.default_rng(0), [0.05, 1, 0.2], NONE)
    np.testing.assert_array_equal(are_shown(told, ["a", "b", "c"]), [True, False, True])


def test_nothing_is_learned_of_a_picture_that_only_noise_changes() -> None:
    """The density of its parameter is a little wrong, and surely so."""
    rng = np.random.default_rng(0)
    space, flat = Space(a=Float(0, 1)), lambda params: 0.5 + 0.01 * rng.random((SIDE, SIDE))
    report = learn(flat, space, renders=300, size=SIDE, passes=2).report
    assert report.unseen == ("a",)
    assert "nothing was learned of a:" in str(report)


REPORT = Report(
    renders=980, failed=0, held_out=20, seconds=3.0, nll=-1.25, within=(0.4, 0.75), coverage=0.9,
    unseen=(), curve=((1.0, -1.0, -1.0),), augment="photograph", scale=1.0, fitted=0, emulated=None,
)  # fmt: skip


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, "1.25 nats better than the uniform prior on 20 held-out renders"),
        ({"nll": 0.44}, "0.44 nats worse than the uniform prior"),
        ({}, "within 0.05 of the box in 40% +- 11%, within 0.1 in 75% +- 10% of 20 pictures"),
        (
            {},
            "90 % regions hold the truth in 90% +- 8% of 20 pictures; not calibrated: that takes ",
        ),
        ({"held_out": 2000, "fitted": 300}, "1,700 held-out renders"),
        ({"held_out": 2000, "fitted": 300}, "300 pictures; calibrated: standard deviations times"),
        ({"failed": 289}, "renders that failed and were left out: 289"),
        ({"unseen": ("dust", "fog")}, "nothing was learned of dust, fog: the images do not show"),
        ({"clutter": "3 backgrounds"}, "augment='photograph', 3 backgrounds"),
        ({"emulated": 0.9}, "explains 90.0% of the variance: it refines hypotheses"),
        ({"emulated": 0.8994}, "explains 89.9% of the variance: too little to be used"),
        ({"emulated": -3.0}, "explains 0.0% of the variance: too little to be used"),
    ],
)
def test_a_report_says_what_was_measured(change: dict[str, Any], said: str) -> None:
    report = replace(REPORT, **change)
    assert said in str(report)
    assert report.emulates == ("it refines" in said)
