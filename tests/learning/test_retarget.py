"""The next picture, with a model of the renderer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins.errors import ModelNotFoundError, OptionError
from fide_plugins.fide import FIDE
from fide_plugins.learning import Model, learn
from fide_plugins.proposers.linear import LinearProposer
from fide_plugins.search.moves import Start
from fide_plugins.space import Float, Space
from fide_plugins.types import Float64, Posterior

from .conftest import SIDE, SPACE, disk

FIRST = disk({"x": 0.3, "y": 0.65, "gray": 0.5, "hidden": 0.5})
NEXT = disk({"x": 0.7, "y": 0.3, "gray": 0.8, "hidden": 0.5})
NEAR = disk({"x": 0.301, "y": 0.649, "gray": 0.502, "hidden": 0.5})


def advance(opt: FIDE, renders: int) -> list[Float64]:
    """Candidates of at least so many more renders."""
    asked, most = [], opt.evaluations + renders
    while opt.evaluations < most:
        asked.append(opt.ask(3))
        opt.tell(asked[-1], [disk(SPACE.decode(x)) for x in asked[-1]])
    return asked


def searched(renders: int, **options: Any) -> FIDE:
    opt = FIDE(SPACE, FIRST, seed=1, **options)
    advance(opt, renders)
    return opt


@pytest.mark.parametrize("known", [True, False])
def test_before_the_first_candidate_it_is_the_search_of_a_new_optimizer(
    known: bool, model: Model
) -> None:
    opt = searched(0, learned=model) if known else searched(0)
    opt.retarget(NEXT, learned=None if known else model)
    new = FIDE(SPACE, NEXT, seed=1, learned=model)
    np.testing.assert_array_equal(advance(opt, 300), advance(new, 300))


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
    advance(opt, 100)
    assert sum(one.probability or 0.0 for one in opt.solutions()) == pytest.approx(1.0)


@pytest.mark.parametrize("proposer", ["none", "both"])
def test_without_a_memory_the_last_best_point_comes_first(proposer: str, model: Model) -> None:
    opt = searched(100, learned=model, proposer=proposer, memory_mb=0)
    assert opt.best is not None and not opt.state.remembered
    best = opt.best.x
    opt.retarget(NEXT)
    expected = np.concatenate([best[None], model.sample(NEXT, 512, 1)[:48]])
    np.testing.assert_array_equal(opt.ask(), expected)


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
def test_a_remembered_candidate_that_is_best_is_searched_as_narrowly_as_memory_says(
    model: Model,
) -> None:
    """Losses say so here: of all that is rendered the remembered one has the lowest."""
    stds = []
    for narrow in (1.0, 1e-3):
        opt = searched(150, learned=model)
        opt.retarget(NEXT)
        start = opt.state.moves.start
        start.std[:] = narrow * start.std
        X = opt.ask()
        opt.tell(X, losses=np.arange(len(X)) + 1.0)
        np.testing.assert_array_equal(opt.state.search.mean, start.mean)
        stds.append(opt.state.search.std)
    assert (stds[1] < 0.01 * stds[0].max()).all()


def test_a_memory_that_is_more_exact_than_the_model_is_searched_alone(model: Model) -> None:
    opt, without = searched(300, learned=model), searched(300, learned=model)
    opt.retarget(NEAR)
    without._model = None
    without.retarget(NEAR)
    np.testing.assert_array_equal(advance(opt, 60), advance(without, 60))
    assert opt.state.moves.move is None and opt.best is not None and opt.best.loss < 1e-4


def test_the_memory_is_compared_with_the_search_that_would_follow() -> None:
    """Also where exchangeable blocks were found: only those that are declared narrow a search."""
    opt = FIDE(4, FIRST, seed=1)
    moves = opt.state.moves
    moves.known.exchangeability.blocks = np.array([[0, 1], [2, 3]])
    posterior = Posterior(np.random.default_rng(0).random((512, 4)))
    start = Start(np.full(4, 0.5), np.full(4, 0.1))
    assert moves.hypotheses.is_wider(posterior, moves.known, start)
    assert not moves.hypotheses.available


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
            np.testing.assert_array_equal(advance(whole, more), advance(parts, more))
    assert parts.state.moves.hypotheses.available


def test_a_loaded_run_takes_the_model_again(model: Model, learned: Path, tmp_path: Path) -> None:
    opt = searched(200, learned=learned)
    opt.save(tmp_path / "run")
    there, without = FIDE.load(tmp_path / "run"), FIDE.load(tmp_path / "run")
    opt.retarget(NEXT)
    there.retarget(NEXT, learned=learned)
    without.retarget(NEXT)
    np.testing.assert_array_equal(advance(opt, 200), advance(there, 200))
    assert without.state.moves.move is None and not without.state.moves.hypotheses.available
    for one in (opt, there):  # both have it now
        one.retarget(FIRST[::-1])
    np.testing.assert_array_equal(advance(opt, 60), advance(there, 60))
    assert opt.state.moves.hypotheses.available


def test_a_run_without_a_model_goes_on_as_one_that_began_with_it(
    model: Model, tmp_path: Path
) -> None:
    opt = searched(100, popsize=4)
    assert opt.state.steps is not None
    opt.retarget(NEXT, learned=model)
    new = FIDE(SPACE, NEXT, seed=1, popsize=4, learned=model)
    assert opt.state.steps is None is new.state.steps
    opt.save(tmp_path / "run")
    again = FIDE.load(tmp_path / "run")
    np.testing.assert_array_equal(advance(opt, 150), advance(again, 150))


def test_more_parameters_than_candidates_are_predicted_from_the_tokens_that_show_them(
    model: Model, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    there = Posterior(np.random.default_rng(0).random((512, 6)))
    opt = FIDE(6, FIRST, seed=1, popsize=4)
    assert isinstance(opt.state.proposer, LinearProposer) and not opt.state.proposer.screening
    monkeypatch.setattr(FIDE, "_model_of", lambda *_: (None, there))
    opt.retarget(NEXT, learned=model)
    opt.save(tmp_path / "run")
    monkeypatch.undo()
    for one in (opt, FIDE.load(tmp_path / "run")):
        assert isinstance(one.state.proposer, LinearProposer) and one.state.proposer.screening
        np.testing.assert_array_equal(one.ask(), there.x[:48])


def test_the_same_picture_again_is_found_at_once(model: Model) -> None:
    """Hypotheses of it are the same: some are remembered, and asked twice."""
    opt = searched(40, learned=model)
    assert opt.best is not None
    best = opt.best
    opt.retarget(FIRST)
    first = opt.ask()
    np.testing.assert_array_equal(first[0], best.x)
    opt.tell(first, [disk(SPACE.decode(x)) for x in first])
    assert opt.best is not None and opt.best.loss <= best.loss
    assert opt.state.population.pending == 0
    advance(opt, 60)


def test_an_unknown_picture_is_searched_as_without_a_model(model: Model) -> None:
    noise = np.random.default_rng(0).random((SIDE, SIDE, 3))
    opt, without = searched(100), searched(100)
    with pytest.warns(RuntimeWarning, match="learned nothing like this picture"):
        opt.retarget(noise, learned=model)
    without.retarget(noise)
    np.testing.assert_array_equal(advance(opt, 50), advance(without, 50))


def test_what_is_no_model_changes_nothing(model: Model, tmp_path: Path) -> None:
    opt, same = searched(50, learned=model), searched(50, learned=model)
    with pytest.raises(OptionError, match="learned is a model or its file, not int"):
        opt.retarget(NEXT, learned=3)
    with pytest.raises(ModelNotFoundError, match="no model at"):
        opt.retarget(NEXT, learned=tmp_path / "absent.fide")
    np.testing.assert_array_equal(advance(opt, 50), advance(same, 50))
    opt.retarget(NEXT)
    assert opt.state.moves.hypotheses.available


def hard_disk(params: dict[str, Any]) -> Float64:
    """Disk of a hard edge, without noise: its radius shows in few pixels."""
    grid = (np.arange(SIDE) + 0.5) / SIDE
    distance = np.hypot(grid[None] - params["x"], grid[:, None] - params["y"])
    image: Float64 = np.clip((0.05 + 0.25 * params["radius"] - distance) * SIDE + 0.5, 0, 1)
    return image


@pytest.mark.thorough
def test_a_far_picture_is_found_about_as_soon_as_by_a_new_optimizer(tmp_path: Path) -> None:
    """Renders to a loss of 1e-4, of eight pairs of pictures."""
    space = Space(x=Float(0, 1), y=Float(0, 1), radius=Float(0, 1))
    model = learn(hard_disk, space, renders=1200, size=SIDE, passes=6, out=tmp_path / "hard.fide")

    def renders(opt: FIDE) -> int:
        before = opt.evaluations
        while opt.best is None or opt.best.loss > 1e-4:
            X = opt.ask()
            opt.tell(X, [hard_disk(space.decode(x)) for x in X])
            assert opt.evaluations < before + 1500
        return opt.evaluations - before

    again, new = 0, 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        first, then = (hard_disk(space.decode(x)) for x in rng.uniform(0.15, 0.85, (2, 3)))
        opt = FIDE(space, first, seed=seed, learned=model)
        renders(opt)
        opt.retarget(then)
        again += renders(opt)
        new += renders(FIDE(space, then, seed=seed, learned=model))
    assert again <= 1.25 * new
