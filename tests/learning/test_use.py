"""A model: hypotheses, its file, and what searches make of it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.stats import gaussian_kde

from fide_lab import run as harness
from fide_plugins import fit
from fide_plugins.errors import CheckpointError, ImageError, ModelNotFoundError, OptionError
from fide_plugins.fide import FIDE
from fide_plugins.learning import Model
from fide_plugins.recording.storage import RunDirectoryError
from fide_plugins.runtime import checkpoint
from fide_plugins.runtime.registry import of_file
from fide_plugins.space import Float, Space
from fide_plugins.types import Float64

from .conftest import SIDE, SPACE, disk

PARAMS = {"x": 0.3, "y": 0.65, "gray": 0.5, "hidden": 0.5}


def test_hypotheses_are_near_the_truth_where_the_image_shows_it(model: Model) -> None:
    samples = model.sample(disk(PARAMS), 200)
    assert np.abs(np.median(samples[:, 0]) - 0.3) < 0.1
    assert np.abs(np.median(samples[:, 1]) - 0.65) < 0.1


def test_a_parameter_without_effect_is_named_and_keeps_its_prior(model: Model) -> None:
    assert model.report.unseen == ("hidden",)
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


def test_a_file_holds_all_of_it(model: Model, learned: Path, tmp_path: Path) -> None:
    model.save(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == learned.read_bytes()


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
        {"dim": 3},
        {"periodic": [True]},
        {"size": [32, 32]},
        {"weights": {}},
        {"report": {}},
        {"space": {"x": 1}},
        {"picture": None},
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


PICTURE = disk({"x": 0.3, "y": 0.65, "gray": 0.5, "hidden": 0.5})


def test_hypotheses_come_first_and_then_a_narrow_search(model: Model, learned: Path) -> None:
    opt = FIDE(SPACE, PICTURE, learned=learned, seed=2)
    first = opt.ask()
    np.testing.assert_array_equal(first, model.sample(PICTURE, 512, 2)[:48])
    opt.tell(first, [disk(SPACE.decode(x)) for x in first])
    best = opt.best
    assert best is not None
    np.testing.assert_array_equal(opt.state.search.mean, best.x)
    std = opt.state.search.std  # narrow in x and y, wide in what the image does not show
    assert std[3] > std[:2].max()


class Scene:
    """The disk as a task."""

    name, dim, space = "disk", SPACE.dim, SPACE
    target = np.repeat(PICTURE[..., None], 3, axis=2).astype(np.float32)

    def render(self, X: Float64, seed: Any = None) -> Float64:
        return np.stack([disk(SPACE.decode(x)) for x in X])


def fitted(learned: Path, budget: int, out: Path | None, *, resume: bool = False) -> Float64:
    arguments: dict[str, Any] = {"out": out, "resume": resume, "workers": 0, "seed": 1}
    return fit(disk, PICTURE, SPACE, budget, learned=learned, **arguments).curve[:, 1]


def run(learned: Path, budget: int, out: Path | None, *, resume: bool = False) -> Float64:
    options = {"learned": str(learned)}
    result = harness.run(Scene(), "fide", "mse", budget, 1, options=options, out=out, resume=resume)
    return np.minimum.accumulate(result.losses)


def test_losses_alone_are_enough(model: Model) -> None:
    opt = FIDE(SPACE, PICTURE, learned=model, seed=1)
    for _ in range(20):
        X = opt.ask()
        opt.tell(X, losses=[float(np.square(disk(SPACE.decode(x)) - PICTURE).mean()) for x in X])
    assert opt.best is not None
    assert opt.best.loss < 1e-4


def test_an_unknown_picture_is_searched_without_the_model(model: Model) -> None:
    noise = np.random.default_rng(0).random((SIDE, SIDE, 3))
    with pytest.warns(RuntimeWarning, match="learned nothing like this picture"):
        opt = FIDE(SPACE, noise, learned=model, seed=3)
    np.testing.assert_array_equal(opt.ask(), FIDE(SPACE, noise, seed=3).ask())


@pytest.mark.parametrize("form", ["gray", "listed", "alpha", "masked"])
def test_any_form_of_one_target_has_hypotheses(form: str, model: Model) -> None:
    picture = PICTURE.astype(np.float32)
    color = np.repeat(picture[..., None], 3, axis=2)
    corner = np.ones((SIDE, SIDE))
    corner[:2, :2] = 0
    target, mask = {
        "gray": (picture, None),
        "listed": ([picture], None),
        "alpha": (np.dstack([color, np.ones((SIDE, SIDE))]), "alpha"),
        "masked": (picture, corner),
    }[form]
    opt = FIDE(SPACE, target, mask=mask, learned=model, seed=1)
    np.testing.assert_array_equal(opt.ask(), FIDE(SPACE, PICTURE, learned=model, seed=1).ask())


def test_several_views_are_refused(model: Model) -> None:
    with pytest.raises(OptionError, match="the target has 2 views: leave out learned"):
        FIDE(SPACE, [PICTURE, PICTURE], learned=model)


def test_a_saved_fit_goes_on_without_the_file_of_its_model(learned: Path, tmp_path: Path) -> None:
    here, moved = tmp_path / "here.fide", tmp_path / "moved.fide"
    shutil.copy(learned, here)
    settings: dict[str, Any] = {"workers": 0, "seed": 0, "popsize": 8}

    def fitted(budget: int, **more: Any) -> Any:
        return fit(disk, PICTURE, SPACE, budget=budget, out=tmp_path / "run", **settings, **more)

    whole = fit(disk, PICTURE, SPACE, budget=65, learned=here, **settings)
    fitted(50, learned=here)
    here.rename(moved)
    with pytest.warns(RuntimeWarning, match="no model at .*goes on without the file"):
        fitted(55, learned=here, resume=True)
    fitted(60, resume=True)
    result = fitted(65, learned=moved, resume=True)
    np.testing.assert_array_equal(result.curve, whole.curve)


def test_another_name_of_the_same_model_is_no_other_model(
    learned: Path, model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor is a model that was given as an object; and settings that differ are said alone."""
    monkeypatch.chdir(tmp_path)
    for name in ("m.fide", "copy.fide"):
        shutil.copy(learned, name)
    replace(model, renderer="another").save("other.fide")
    settings: dict[str, Any] = {"workers": 0, "seed": 0, "out": "run"}

    def fitted(budget: int, model: Any, **more: Any) -> Any:
        return fit(disk, PICTURE, SPACE, budget=budget, learned=model, **(settings | more))

    fitted(10, "m.fide")
    same: list[Any] = [tmp_path / "m.fide", "./m.fide", "copy.fide", Model.load("m.fide")]
    for budget, one in zip((11, 12, 14, 16), same, strict=True):
        assert fitted(budget, one, resume=True).evaluations == budget
    with pytest.raises(RunDirectoryError, match="seed is 0 there and 1 here"):
        fitted(18, "other.fide", resume=True, seed=1)
    assert fitted(18, "other.fide", resume=True).evaluations == 18


@pytest.mark.parametrize("run", [fitted, run])
def test_a_saved_search_goes_on_with_its_hypotheses_though_the_model_was_learned_again(
    run: Callable[..., Float64], learned: Path, model: Model, tmp_path: Path
) -> None:
    here, out = tmp_path / "m.fide", tmp_path / "run"
    shutil.copy(learned, here)
    whole = run(here, 65, None)
    run(here, 50, out)
    before = json.loads((out / "run.json").read_text()).get("sources")
    assert run is fitted or before[f"learned={here}"] == [of_file(learned)]
    here.touch()
    run(here, 55, out, resume=True)
    replace(model, renderer="another").save(here)
    np.testing.assert_array_equal(run(here, 65, out, resume=True), whole)
    assert json.loads((out / "run.json").read_text()).get("sources") == before


FIRST = disk({"x": 0.3, "y": 0.65, "gray": 0.5, "hidden": 0.5})
NEXT = disk({"x": 0.7, "y": 0.3, "gray": 0.8, "hidden": 0.5})
NEAR = disk({"x": 0.301, "y": 0.649, "gray": 0.502, "hidden": 0.5})


def go_on(opt: FIDE, renders: int) -> list[Float64]:
    """Candidates of at least so many more renders."""
    asked, most = [], opt.evaluations + renders
    while opt.evaluations < most:
        asked.append(opt.ask(3))
        opt.tell(asked[-1], [disk(SPACE.decode(x)) for x in asked[-1]])
    return asked


def searched(renders: int, **options: Any) -> FIDE:
    opt = FIDE(SPACE, FIRST, seed=1, **options)
    go_on(opt, renders)
    return opt


@pytest.mark.parametrize("renders", [20, 60, 300])
def test_hypotheses_of_the_picture_follow_what_is_remembered(renders: int, model: Model) -> None:
    opt = searched(renders, learned=model)
    before = {x.tobytes() for x in (one.x for one in opt.state.remembered)}
    opt.retarget(NEXT)
    asked = opt.ask()
    remembered, drawn = asked[:-48], asked[-48:]
    np.testing.assert_array_equal(drawn, model.sample(NEXT, 512, 1)[:48])
    assert 1 <= len(remembered) <= 3 and {x.tobytes() for x in remembered} <= before
    opt.tell(asked, [disk(SPACE.decode(x)) for x in asked])
    assert opt.best is not None
    np.testing.assert_array_equal(opt.state.search.mean, opt.best.x)  # the best of both
    go_on(opt, 100)
    assert sum(one.probability or 0.0 for one in opt.solutions()) == pytest.approx(1.0)


def test_a_guess_comes_before_all_hypotheses(model: Model) -> None:
    x = SPACE.encode({"x": 0.31, "y": 0.64, "gray": 0.52, "hidden": 0.5})
    opt = FIDE(SPACE, FIRST, seed=1, learned=model, x0=x)
    asked = opt.ask()
    np.testing.assert_array_equal(asked[0], x)
    np.testing.assert_array_equal(asked[1:], FIDE(SPACE, FIRST, seed=1, learned=model).ask())
    opt.tell(asked, [disk(SPACE.decode(x)) for x in asked])
    assert opt.state.searches == 2 and opt.best is not None
    np.testing.assert_array_equal(opt.state.search.mean, opt.best.x)  # the best of both
    opt.retarget(NEXT)
    assert not np.array_equal(opt.ask(1)[0], x)  # it was a guess of the first picture


@pytest.mark.thorough
@pytest.mark.parametrize("renders", [0, 30, 200])
def test_a_saved_run_goes_on_bit_for_bit(renders: int, model: Model, tmp_path: Path) -> None:
    whole, parts = searched(renders, learned=model), searched(renders, learned=model)
    whole.retarget(NEXT)
    parts.retarget(NEXT)
    for more in (0, 20, 40, 100, 100):
        parts.save(tmp_path / "run")
        parts = FIDE.load(tmp_path / "run")
        if more:
            np.testing.assert_array_equal(go_on(whole, more), go_on(parts, more))
    assert parts.state.moves.hypotheses is not None


def test_a_loaded_run_takes_the_model_again(model: Model, learned: Path, tmp_path: Path) -> None:
    opt = searched(200, learned=learned)
    opt.save(tmp_path / "run")
    there, without = FIDE.load(tmp_path / "run"), FIDE.load(tmp_path / "run")
    opt.retarget(NEXT)
    there.retarget(NEXT, learned=learned)
    without.retarget(NEXT)
    np.testing.assert_array_equal(go_on(opt, 200), go_on(there, 200))
    kept = without.state.moves.hypotheses  # with none of another picture
    assert without.state.moves.move is None and kept is not None and not kept.available
    for one in (opt, there):  # both have it now
        one.retarget(FIRST[::-1])
    np.testing.assert_array_equal(go_on(opt, 60), go_on(there, 60))
    assert opt.state.moves.hypotheses is not None


def test_what_is_no_model_changes_nothing(model: Model, tmp_path: Path) -> None:
    opt, same = searched(50, learned=model), searched(50, learned=model)
    with pytest.raises(OptionError, match="learned is a model or its file, not int"):
        opt.retarget(NEXT, learned=3)
    with pytest.raises(ModelNotFoundError, match="no model at"):
        opt.retarget(NEXT, learned=tmp_path / "absent.fide")
    np.testing.assert_array_equal(go_on(opt, 50), go_on(same, 50))
    opt.retarget(NEXT)
    assert opt.state.moves.hypotheses is not None
