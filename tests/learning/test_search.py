"""A search that begins with a model's hypotheses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fide_plugins.errors import OptionError
from fide_plugins.fide import FIDE
from fide_plugins.learning import Model
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


@pytest.mark.parametrize("renders", [0, 20, 120])
def test_the_next_picture_is_not_searched_at_hypotheses_of_the_first(
    renders: int, model: Model, tmp_path: Path
) -> None:
    opt = FIDE(SPACE, PICTURE, learned=model, seed=1)
    advance(opt, renders)
    opt.retarget(disk({"x": 0.7, "y": 0.3, "gray": 0.8, "hidden": 0.5}))
    assert opt.state.moves.move is None and not opt.state.moves.hypotheses.waiting
    opt.save(tmp_path / "run")
    again = FIDE.load(tmp_path / "run")
    for one in (opt, again):
        X = one.ask()
        one.tell(X, losses=np.arange(len(X)) + 1.0)
    np.testing.assert_array_equal(opt.ask(), again.ask())
