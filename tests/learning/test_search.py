"""A search that begins with a model's hypotheses."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab import run as harness
from fide_plugins import fit
from fide_plugins.errors import ModelNotFoundError, OptionError
from fide_plugins.fide import FIDE
from fide_plugins.learning import Model
from fide_plugins.learning.hypotheses import posterior_of
from fide_plugins.recording.storage import RunDirectoryError
from fide_plugins.runtime.registry import of_file
from fide_plugins.types import Float64

from .conftest import SIDE, SPACE, disk

PICTURE = disk({"x": 0.3, "y": 0.65, "gray": 0.5, "hidden": 0.5})


def advance(opt: FIDE, renders: int) -> list[Float64]:
    asked = []
    while opt.evaluations < renders:
        asked.append(opt.ask())
        opt.tell(asked[-1], [disk(SPACE.decode(x)) for x in asked[-1]])
    return asked


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


def test_hypotheses_are_better_than_random_candidates(model: Model) -> None:
    rng = np.random.default_rng(5)

    def good_loss(X: Float64, picture: Float64) -> float:
        losses = [np.square(disk(SPACE.decode(x)) - picture).mean() for x in X]
        return float(np.quantile(losses, 0.1))

    hypotheses, others = 0.0, 0.0
    for truth in rng.random((5, 4)):
        picture = disk(SPACE.decode(truth))
        hypotheses += good_loss(model.sample(picture, 48), picture)
        others += good_loss(rng.random((48, 4)), picture)
    assert hypotheses < 0.7 * others


def test_a_saved_run_goes_on_without_the_model(model: Model, tmp_path: Path) -> None:
    whole = advance(FIDE(SPACE, PICTURE, learned=model, seed=1), 200)
    opt = FIDE(SPACE, PICTURE, learned=model, seed=1)
    again = []
    for renders in (20, 110, 200):
        again += advance(opt, renders)
        opt.save(tmp_path / "run")
        opt = FIDE.load(tmp_path / "run")
    np.testing.assert_array_equal(np.concatenate(whole), np.concatenate(again))


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


@pytest.mark.thorough
@pytest.mark.parametrize("run", [fitted, run])
def test_hypotheses_are_made_only_where_no_state_is_saved(
    run: Callable[..., Float64], learned: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They may take seconds. Until then a resumed run is one that begins."""
    asked: list[bool] = []

    def noted(learned: Any, *about: Any) -> Any:
        asked.append(learned is not None)
        return posterior_of(learned, *about)

    monkeypatch.setattr("fide_plugins.learning.hypotheses.posterior_of", noted)
    whole = run(learned, 120, None)
    assert any(asked)
    asked.clear()
    run(learned, 60, tmp_path, resume=True)  # nothing is there
    assert any(asked)
    asked.clear()
    np.testing.assert_array_equal(run(learned, 120, tmp_path, resume=True), whole)
    assert not any(asked)
    asked.clear()
    for name in ("run.ckpt", "curve.csv"):  # as if it had been killed before there was a state
        (tmp_path / name).unlink()
    np.testing.assert_array_equal(run(learned, 120, tmp_path, resume=True), whole)
    assert any(asked)


@pytest.mark.thorough
def test_all_distinct_hypotheses_have_their_turn_before_other_moves(model: Model) -> None:
    opt = FIDE(SPACE, PICTURE, learned=model, seed=1)
    while opt.state.moves.hypotheses.waiting or opt.evaluations < 100:
        assert opt.state.moves.move in ("learned", "resample", "refine")
        assert opt.evaluations < 6000
        advance(opt, opt.evaluations + 1)


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


def test_another_space_is_refused(model: Model) -> None:
    with pytest.raises(OptionError, match="4 parameters"):
        FIDE(7, PICTURE, learned=model)
    with pytest.raises(OptionError, match="learned is a model or its file, not int"):
        FIDE(4, PICTURE, learned=3)


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


def test_what_a_mask_hides_may_make_a_picture_unknown(model: Model) -> None:
    mask = np.ones((SIDE, SIDE))
    mask[:, 8:] = 0
    spoiled = np.where(mask > 0, PICTURE, np.random.default_rng(0).random((SIDE, SIDE)))
    with pytest.warns(RuntimeWarning, match="learned nothing like this picture"):
        FIDE(SPACE, spoiled, mask=mask, learned=model, seed=1)


def test_several_views_are_refused(model: Model) -> None:
    with pytest.raises(OptionError, match="the target has 2 views: leave out learned"):
        FIDE(SPACE, [PICTURE, PICTURE], learned=model)


def test_a_file_that_is_missing_is_named_with_what_makes_one(tmp_path: Path) -> None:
    absent, said = tmp_path / "absent.fide", r"no model at .*absent\.fide: .fide learn. or .learn"
    with pytest.raises(ModelNotFoundError, match=said):
        FIDE(SPACE, PICTURE, learned=absent)
    with pytest.raises(ModelNotFoundError, match=said):
        fit(disk, PICTURE, SPACE, budget=10, learned=absent, workers=0)


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
    recorded = json.loads((tmp_path / "run" / "run.json").read_text())["settings"]["options"]
    assert recorded["learned"] == str(here)


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
    with pytest.warns(RuntimeWarning, match=r"hypotheses of m\.fide.*other\.fide' is not used"):
        fitted(18, "other.fide", resume=True)


@pytest.mark.parametrize("run", [fitted, run])
def test_a_saved_search_says_that_its_model_was_learned_again(
    run: Callable[..., Float64], learned: Path, model: Model, tmp_path: Path
) -> None:
    """It goes on with the hypotheses that it has, so the record names no other model."""
    here, out = tmp_path / "m.fide", tmp_path / "run"
    shutil.copy(learned, here)
    whole = run(here, 65, None)
    run(here, 50, out)
    before = json.loads((out / "run.json").read_text())["sources"]
    assert before[f"learned={here}"] == [of_file(learned)]
    here.touch()
    run(here, 55, out, resume=True)
    replace(model, renderer="another").save(here)
    with pytest.warns(RuntimeWarning, match="hypotheses of .*m.fide' has changed since and is not"):
        np.testing.assert_array_equal(run(here, 65, out, resume=True), whole)
    assert json.loads((out / "run.json").read_text())["sources"] == before


def test_a_saved_run_says_that_the_model_of_its_encoder_was_learned_again(
    learned: Path, model: Model, tmp_path: Path
) -> None:
    here, out = tmp_path / "m.fide", tmp_path / "run"
    shutil.copy(learned, here)
    settings: dict[str, Any] = {"options": {"encoder": f"learned:{here}"}, "out": out}

    def resumed(budget: int) -> None:
        harness.run(Scene(), "fide-annealing", "mse", budget, 1, resume=True, **settings)

    resumed(10)
    resumed(20)
    replace(model, renderer="another").save(here)
    with pytest.warns(RuntimeWarning, match="m.fide has changed since the run in .*undo it"):
        resumed(30)
    versions = json.loads((out / "run.json").read_text())["sources"][f"encoder=learned:{here}"]
    assert versions == [of_file(learned), of_file(here)]


def test_a_fit_without_a_model_gets_none_later(learned: Path, tmp_path: Path) -> None:
    settings: dict[str, Any] = {"workers": 0, "seed": 0, "out": tmp_path}
    fit(disk, PICTURE, SPACE, budget=10, **settings)
    with pytest.raises(RunDirectoryError, match="other settings: options"):
        fit(disk, PICTURE, SPACE, budget=20, learned=learned, resume=True, **settings)
