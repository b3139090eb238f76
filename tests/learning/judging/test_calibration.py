"""Calibration: a density that is too sure of itself is mended, and nothing else is touched."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from fide_plugins.errors import CheckpointError
from fide_plugins.learning import Model, learn
from fide_plugins.learning.judging import LARGEST_SCALE, fitted_scale, split_held_out
from fide_plugins.learning.networks import Components, Network, as_input
from fide_plugins.runtime import checkpoint
from tests.learning.conftest import SIDE

KINDS: list[tuple[str, list[list[int]]]] = [
    ("autoregressive", []),
    ("mixture", []),
    ("set", [[0, 1], [2, 3]]),
]
PERIODIC = (False, True, False, True, False)
PICTURE = np.full((1, SIDE, SIDE, 3), 100, np.uint8)


def network(head: str, blocks: list[list[int]]) -> Network:
    made = Network((SIDE, SIDE), PERIODIC, head, blocks, seed=3)
    made.eval()
    return made


def drawn(of: Network, n: int, seed: int = 0) -> Tensor:
    return of.sample(as_input(PICTURE), n, torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("head", "blocks"), KINDS)
def test_a_scale_of_one_changes_nothing(head: str, blocks: list[list[int]]) -> None:
    plain, scaled = network(head, blocks), network(head, blocks)
    scaled.scale = 2.0
    u = drawn(plain, 50)
    p = plain.log_prob(as_input(PICTURE), u)
    assert not torch.equal(p, scaled.log_prob(as_input(PICTURE), u))
    assert not torch.equal(u, drawn(scaled, 50))
    scaled.scale = 1.0
    assert torch.equal(p, scaled.log_prob(as_input(PICTURE), u))
    assert torch.equal(u, drawn(scaled, 50))
    assert plain.state_dict().keys() == scaled.state_dict().keys()


def narrow(of: Network, to: float) -> None:
    """Make all standard deviations about `to`."""
    heads = [of.head, of.head.rest] if hasattr(of.head, "rest") else [of.head]
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
@pytest.mark.parametrize(("head", "blocks"), KINDS)
def test_the_scale_that_was_lost_is_found(head: str, blocks: list[list[int]]) -> None:
    """Parameters come from a density; one that is half as wide is mended."""
    true = network(head, blocks)
    narrow(true, 0.03)
    u = drawn(true, 120).numpy().astype(np.float64)
    images = np.repeat(PICTURE, len(u), axis=0)
    sure = network(head, blocks)
    narrow(sure, 0.015)
    found = fitted_scale(sure, u, images)
    on_a_circle = 2 ** (np.log(0.5 / 2e-3) / np.log(1 / 2e-3))  # 1.85
    assert on_a_circle * 0.8 < found < 2 * 1.2  # 120 renders tell it to 5 %
    assert sure.scale == 1.0  # as it was
    assert fitted_scale(true, u, images) == pytest.approx(1.0, abs=0.2)
    narrow(sure, 0.06)
    assert fitted_scale(sure, u, images) == 1.0  # never narrower


def test_the_scale_has_an_end() -> None:
    sure = network("mixture", [])
    narrow(sure, 0.003)
    u = np.random.default_rng(0).random((60, 5))
    said: list[tuple[int, int]] = []
    images = np.repeat(PICTURE, 60, axis=0)
    scale = fitted_scale(sure, u, images, on_picture=lambda *at: said.append(at))
    assert scale == LARGEST_SCALE
    assert said == [(i + 1, 9 * 60) for i in range(9 * 60)]  # from 1 to 4 by steps of 1.2


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("scale", [0.25, 1.5, 4.0])
def test_a_widened_density_integrates_to_one(periodic: bool, scale: float) -> None:
    raw = torch.randn(40, 1, 3, 4, generator=torch.Generator().manual_seed(0))
    found = Components.of(raw, torch.tensor([periodic])).widened(scale)
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
    assert fitted_scale(network("mixture", []), np.zeros((0, 5)), PICTURE[:0]) == 1.0


@pytest.mark.thorough
def test_the_scale_comes_with_the_file(tmp_path: Path) -> None:
    def gray(x: Any) -> Any:
        return np.broadcast_to(x[0], (SIDE, SIDE))

    learned = learn(gray, 2, renders=5000, size=SIDE, passes=1)
    assert (learned.report.fitted, learned.report.held_out) == (50, 100)
    assert learned.report.scale == learned.network.scale
    assert "calibrated by 50 other held-out renders" in str(learned.report)
    learned.network.scale = 1.3
    model = replace(learned, report=replace(learned.report, scale=1.3))
    model.save(tmp_path / "m")
    again = Model.load(tmp_path / "m")
    assert again.network.scale == 1.3
    assert again.report == model.report
    picture = gray([0.4])
    np.testing.assert_array_equal(again.sample(picture, 8), model.sample(picture, 8))


def test_an_impossible_scale_is_refused(learned: Path, tmp_path: Path) -> None:
    state = checkpoint.read(learned, "learned model")
    state["scale"] = -1.0
    checkpoint.write(tmp_path / "m", "learned model", state)
    with pytest.raises(CheckpointError, match="scale"):
        Model.load(tmp_path / "m")
