"""A model that has learned a disk: what it says of pictures, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.stats import gaussian_kde

from fide_plugins.errors import CheckpointError, ImageError, OptionError
from fide_plugins.learning import Model
from fide_plugins.runtime import checkpoint
from fide_plugins.space import Float, Space

from .conftest import SIDE, disk

PARAMS = {"x": 0.3, "y": 0.65, "gray": 0.5, "hidden": 0.5}


def test_most_of_the_box_is_excluded(model: Model) -> None:
    assert model.report.nll < -2  # the uniform prior has 0
    assert model.report.within[1] > 0.4


def test_hypotheses_are_near_the_truth_where_the_image_shows_it(model: Model) -> None:
    samples = model.sample(disk(PARAMS), 200)
    assert np.abs(np.median(samples[:, 0]) - 0.3) < 0.1
    assert np.abs(np.median(samples[:, 1]) - 0.65) < 0.1


def test_a_parameter_without_effect_is_named_and_keeps_its_prior(model: Model) -> None:
    assert model.report.unseen == ("hidden",)
    assert model.report.parameters == 4
    assert "in the 3 of 4 parameters that the images show" in str(model.report)
    quartiles = np.quantile(model.sample(disk(PARAMS), 1000)[:, 3], [0.25, 0.5, 0.75])
    np.testing.assert_allclose(quartiles, [0.25, 0.5, 0.75], atol=0.1)


def test_the_density_integrates_to_one(model: Model) -> None:
    """The mean of 1 / p over samples of p is the volume where p is not 0, which is at most 1."""
    picture = disk(PARAMS)
    samples = model.sample(picture, 2000)
    inside = np.exp(-model.log_prob(picture, samples)).mean()
    assert inside < 1.1
    around = gaussian_kde(samples.T)  # importance sampling: where p is, so that few draws decide
    X = around.resample(4000, seed=0).T
    X = X[((X >= 0) & (X <= 1)).all(axis=1)]
    weights = np.exp(model.log_prob(picture, X)) / around(X.T)
    assert 0.9 < weights.sum() / 4000 < 1.1  # the integral of p


def test_same_seed_same_hypotheses(model: Model) -> None:
    picture = disk(PARAMS)
    np.testing.assert_array_equal(model.sample(picture, 8, 3), model.sample(picture, 8, 3))
    assert not np.array_equal(model.sample(picture, 8, 3), model.sample(picture, 8, 4))


def test_an_autocast_of_the_caller_changes_nothing(model: Model) -> None:
    def results() -> list[object]:
        picture = disk(PARAMS)
        X = model.sample(picture, 8)
        return [X, model.log_prob(picture, X), model.unfamiliarity(picture)]

    expected = results()
    with torch.autocast("cpu", torch.bfloat16):
        for result, value in zip(results(), expected, strict=True):
            np.testing.assert_array_equal(result, value)


def test_other_sizes_are_resized(model: Model, tmp_path: Path) -> None:
    picture = disk(PARAMS)
    large = np.rint(np.kron(picture, np.ones((4, 4))) * 255).astype(np.uint8)
    Image.fromarray(large).save(tmp_path / "large.png")
    samples = model.sample(tmp_path / "large.png", 8)
    np.testing.assert_allclose(samples, model.sample(picture, 8), atol=0.05)


def test_another_aspect_is_refused(model: Model) -> None:
    with pytest.raises(ImageError, match=r"16 x 16 pixels .* this picture is 16 x 24"):
        model.sample(np.zeros((24, 16, 3)))


def test_a_picture_unlike_all_renders_is_noticed(model: Model) -> None:
    assert model.knows(disk(PARAMS))
    noise = np.random.default_rng(0).random((SIDE, SIDE, 3))
    assert not model.knows(noise)


def test_regions_of_high_density_hold_the_truth(model: Model) -> None:
    assert 0.7 < model.report.coverage <= 1  # of 24 pictures
    assert min(model.report.ranks) > 0.7


def test_a_file_holds_all_of_it(model: Model, learned: Path, tmp_path: Path) -> None:
    model.save(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == learned.read_bytes()


def test_a_model_of_a_version_that_kept_no_picture_is_loaded(
    model: Model, learned: Path, tmp_path: Path
) -> None:
    state = checkpoint.read(learned, "learned model")
    del state["picture"]
    checkpoint.write(tmp_path / "old", "learned model", state)
    picture = np.zeros((SIDE, SIDE))
    np.testing.assert_array_equal(
        Model.load(tmp_path / "old").sample(picture, 4), model.sample(picture, 4)
    )


def test_damaged_and_other_files_are_refused(learned: Path, tmp_path: Path) -> None:
    data = bytearray(learned.read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "damaged").write_bytes(data)
    with pytest.raises(CheckpointError, match="checksum"):
        Model.load(tmp_path / "damaged")
    checkpoint.write(tmp_path / "other", "fide", {})
    with pytest.raises(CheckpointError, match="it holds a 'fide'"):
        Model.load(tmp_path / "other")


@pytest.mark.parametrize(
    "change",
    [
        {"head": "none"},
        {"dim": 3},
        {"periodic": [True]},
        {"size": [32, 32]},
        {"weights": {}},
        {"report": {}},
        {"space": {"x": 1}},
        {"picture": np.zeros((8, 8, 3), np.uint8)},
    ],
    ids=lambda change: next(iter(change)),
)
def test_impossible_contents_are_refused(
    learned: Path, tmp_path: Path, change: dict[str, object]
) -> None:
    state = checkpoint.read(learned, "learned model")
    checkpoint.write(tmp_path / "odd", "learned model", {**state, **change})
    with pytest.raises(CheckpointError, match="impossible contents"):
        Model.load(tmp_path / "odd")


def test_units_make_no_other_space(model: Model) -> None:
    model.check_space(Space({name: Float(0, 1, unit="m") for name in ("x", "y", "gray", "hidden")}))
    assert model.space is not None
    in_another_order = Space(dict(reversed(model.space.parameters.items())))
    with pytest.raises(OptionError, match="the parameters come in another order"):
        model.check_space(in_another_order)


@pytest.mark.parametrize("name", ["", "m.fide.renders"])
def test_a_folder_is_no_model(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("m.fide.renders").mkdir()
    with pytest.raises(IsADirectoryError, match=f"^'{name}' is a folder; name the model's file"):
        Model.load(name)


def test_another_space_is_refused_with_the_difference(model: Model) -> None:
    model.check_space(4)
    with pytest.raises(OptionError, match="has 4 parameters, and the optimizer 5"):
        model.check_space(5)
    other = Space(x=Float(0, 1), y=Float(0, 2), gray=Float(0, 1), hidden=Float(0, 1))
    with pytest.raises(OptionError, match=r"'y' is Float\(0.0, 1.0\) in the model and Float"):
        model.check_space(other)
