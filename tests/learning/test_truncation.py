"""The second round: where it renders, and what is learned of it."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.stats import kstest

from fide_plugins import FIDE
from fide_plugins.errors import OptionError
from fide_plugins.learning import Model, learn
from fide_plugins.learning.pipeline import Truncated, choose_evenly
from fide_plugins.types import Float64

from .conftest import SIDE, SPACE, disk

pytestmark = pytest.mark.thorough

TRUTH = np.array([0.3, 0.65, 0.5, 0.5])
PICTURE = disk(SPACE.decode(TRUTH))
OTHER = disk(SPACE.decode(np.array([0.6, 0.4, 0.9, 0.5])))


def test_a_choice_is_as_if_drawn_uniformly() -> None:
    rng = np.random.default_rng(0)
    u = np.sqrt(0.04 + 0.96 * rng.random(48_000))  # of density 2 u / 0.96 in [0.2, 1]
    chosen = choose_evenly(np.log(u), 3000, rng)
    assert len(set(chosen)) == 3000
    assert kstest(u[chosen], "uniform", (0.2, 0.8)).statistic < 0.04
    assert kstest(u, "uniform", (0.2, 0.8)).statistic > 0.15


@pytest.fixture(scope="module")
def region(learned: Path) -> Truncated:
    return Truncated.read(learned, PICTURE, seed=0)


def test_points_are_where_the_posterior_is(region: Truncated, model: Model) -> None:
    points = np.concatenate([region.parameters(shard) for shard in range(5)])
    assert points.shape == (500, 4) and points.min() >= 0 and points.max() <= 1
    assert (model.log_prob(PICTURE, points) >= region.threshold).all()
    everywhere = np.random.default_rng(1).random((2000, 4))
    assert (model.log_prob(PICTURE, everywhere) >= region.threshold).mean() < 0.8
    assert model.log_prob(PICTURE, TRUTH[None])[0] >= region.threshold
    assert kstest(points[:, 3], "uniform").statistic < 0.15  # images do not show it


def test_a_shard_is_the_same_each_time_and_another_with_another_seed(
    region: Truncated, learned: Path
) -> None:
    again = Truncated.read(learned, PICTURE, seed=0)
    np.testing.assert_array_equal(again.parameters(3), region.parameters(3))
    other = Truncated.read(learned, PICTURE, seed=1)
    assert not np.array_equal(other.parameters(3), region.parameters(3))
    assert not np.array_equal(region.parameters(4), region.parameters(3))


def test_two_rounds_know_their_picture_better_than_one(
    learned: Path, model: Model, tmp_path: Path
) -> None:
    arguments: dict[str, Any] = {"renders": 600, "size": SIDE, "passes": 6}
    second = learn(disk, SPACE, **arguments, out=tmp_path / "s", after=learned, picture=PICTURE)
    assert second.report.renders + second.report.held_out == 1800
    hypotheses = [each.sample(PICTURE, 256)[:, :3] for each in (model, second)]
    before, after = (np.abs(x - TRUTH[:3]).mean() for x in hypotheses)
    assert after < 0.8 * before


def test_a_search_for_another_picture_than_that_of_the_second_round_is_warned(
    learned: Path, tmp_path: Path
) -> None:
    """The same one in another size, or after rounding, is no other."""
    file = tmp_path / "s"
    learn(disk, SPACE, renders=200, size=SIDE, passes=1, out=file, after=learned, picture=PICTURE)
    image = Image.fromarray(np.rint(255 * PICTURE).astype(np.uint8))
    larger = image.resize((3 * SIDE // 2, 3 * SIDE // 2), Image.Resampling.LANCZOS)
    for same in (PICTURE, image, larger):
        FIDE(SPACE, same, learned=file)
    FIDE(SPACE, OTHER, learned=learned)  # of the first round
    with pytest.warns(RuntimeWarning, match="one of a second round, for another picture: its hyp"):
        FIDE(SPACE, OTHER, learned=file)


def test_a_second_round_for_an_unknown_picture_is_warned(learned: Path, tmp_path: Path) -> None:
    noise = np.random.default_rng(0).random((SIDE, SIDE, 3))
    why = "learned nothing like this picture .*: a second round renders where that model guesses"
    with pytest.warns(RuntimeWarning, match=why):
        learn(disk, SPACE, renders=100, size=SIDE, passes=1, after=learned, picture=noise)


class Noisy:
    """Gray images whose level is 0.2 + 0.6 x, with noise of 0.06 that all pixels share."""

    name, dim = "noisy", 1

    def render(self, X: Float64, seed: Any = (0,)) -> Float64:
        noise = [np.random.default_rng(one).standard_normal() for one in seed]
        level = 0.2 + 0.6 * X[:, 0] + 0.06 * np.array(noise)
        return np.clip(np.broadcast_to(level[:, None, None], (len(X), SIDE, SIDE)), 0, 1)


def test_in_the_region_points_are_as_of_the_prior(tmp_path: Path) -> None:
    """Samples of the posterior, in their place, would make that of the second round narrower."""
    picture = np.full((SIDE, SIDE), 0.5)
    file = tmp_path / "noisy.fide"
    model = learn(Noisy(), renders=1000, size=SIDE, passes=4, out=file)
    region = Truncated.read(file, picture, seed=0)
    grid = np.linspace(0, 1, 2001)
    inside = grid[model.log_prob(picture, grid[:, None]) >= region.threshold]
    assert len(inside) < 1900

    def unevenness(points: Float64) -> float:
        """Largest difference of their distribution from the uniform one in the region."""
        within = np.searchsorted(inside, points[:, 0]) / len(inside)
        return float(kstest(within, "uniform").statistic)

    assert unevenness(region.points(3000, seed=1)) < 0.05
    assert unevenness(model.sample(picture, 3000)) > 0.1


def test_what_does_not_fit_is_refused(learned: Path, tmp_path: Path) -> None:
    arguments: dict[str, Any] = {"renders": 100, "size": SIDE, "passes": 1, "after": learned}
    with pytest.raises(OptionError, match="needs both: after=MODEL and picture=PICTURE"):
        learn(disk, SPACE, **arguments)
    with pytest.raises(OptionError, match="4 parameters, and the optimizer 2"):
        learn(lambda x: PICTURE, 2, **arguments, picture=PICTURE)
    with pytest.raises(OptionError, match=r"the size of the model is \[16, 16\], and here"):
        learn(disk, SPACE, **{**arguments, "size": 32}, picture=PICTURE)
    second = tmp_path / "second"
    learn(disk, SPACE, **arguments, picture=PICTURE, out=second)
    with pytest.raises(OptionError, match="needs a model of the whole space"):
        learn(disk, SPACE, **{**arguments, "after": second}, picture=PICTURE)
    with pytest.raises(OptionError, match="holds other renders: they are of another picture; name"):
        learn(disk, SPACE, **arguments, picture=OTHER, out=second)
    first: dict[str, Any] = {**arguments, "after": None, "out": tmp_path / "first"}
    learn(disk, SPACE, **first)
    with pytest.raises(OptionError, match="holds other renders: they are of a first round; name"):
        learn(disk, SPACE, **{**first, "after": learned}, picture=PICTURE)
    with pytest.raises(OptionError, match="holds other renders: they are of a second round; name"):
        learn(disk, SPACE, **{**first, "out": second})
    with pytest.raises(OptionError, match="renders: they were made after another model; name"):
        learn(disk, SPACE, **{**arguments, "after": first["out"]}, picture=PICTURE, out=second)
    shutil.copy(learned, tmp_path / "alone")
    with pytest.raises(OptionError, match="the renders of the model .*alone are missing"):
        learn(disk, SPACE, **{**arguments, "after": tmp_path / "alone"}, picture=PICTURE)
