"""The ask/tell protocol, for every baseline."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins import checkpoint, optimizers
from fide_plugins.baselines.base import Baseline
from fide_plugins.baselines.cma import CMA
from fide_plugins.baselines.random import Random
from fide_plugins.errors import (
    CheckpointError,
    ImageError,
    LossError,
    OptionError,
    PointsError,
    UnknownNameError,
)
from fide_plugins.points import Float64

BASELINES: list[type[Baseline]] = [CMA, Random]
every_baseline = pytest.mark.parametrize("cls", BASELINES, ids=lambda cls: cls.name)


def sphere(X: Float64) -> Float64:
    value: Float64 = ((X - 0.3) ** 2).sum(axis=1)
    return value


def minimize(opt: Baseline, evaluations: int) -> list[Float64]:
    asked = []
    while opt.evaluations < evaluations:
        X = opt.ask()
        opt.tell(X, losses=sphere(X))
        asked.append(X)
    return asked


@every_baseline
@pytest.mark.parametrize("dim", [1, 2, 7, 40])
def test_candidates_lie_in_the_box_and_the_best_is_kept(cls: type[Baseline], dim: int) -> None:
    opt = cls(dim, seed=1)
    assert opt.best is None
    np.testing.assert_array_equal(opt.recommend(), np.full(dim, 0.5))
    X = np.concatenate(minimize(opt, 300))
    assert X.dtype == np.float64 and X.shape == (opt.evaluations, dim)
    assert X.min() >= 0.0 and X.max() <= 1.0
    losses = sphere(X)
    assert opt.best is not None
    assert opt.best.evaluation == losses.argmin()
    assert opt.best.loss == losses.min()
    np.testing.assert_array_equal(opt.best.x, X[losses.argmin()])


@every_baseline
def test_pieces_and_order_do_not_matter(cls: type[Baseline]) -> None:
    whole, pieces = cls(5, seed=3), cls(5, seed=3)
    rng = np.random.default_rng(0)
    for X in minimize(whole, 150):
        Y = np.concatenate([pieces.ask(1), pieces.ask(2), pieces.ask()])
        np.testing.assert_array_equal(X, Y)
        for part in np.array_split(rng.permutation(len(Y)), 3):
            pieces.tell(Y[part], losses=sphere(Y[part]))
    np.testing.assert_array_equal(whole.ask(), pieces.ask())


@every_baseline
def test_many_workers_with_late_results(cls: type[Baseline]) -> None:
    opt = cls(4, seed=0)
    waiting = opt.ask(3 * opt.popsize + 1)
    rng = np.random.default_rng(0)
    for _ in range(400):
        i = int(rng.integers(len(waiting)))
        opt.tell(waiting[i : i + 1], losses=sphere(waiting[i : i + 1]))
        waiting = np.concatenate([np.delete(waiting, i, axis=0), opt.ask(1)])
    assert opt.evaluations == 400
    assert opt.best is not None
    assert opt.best.loss < (1e-4 if cls is CMA else 0.1)


@every_baseline
def test_global_random_state_is_neither_read_nor_changed(cls: type[Baseline]) -> None:
    def run(global_seed: int) -> Float64:
        np.random.seed(global_seed)
        random.seed(global_seed)
        before = np.random.get_state()[1].tolist(), random.getstate()  # type: ignore[index]
        X = np.concatenate(minimize(cls(3, seed=5), 500))  # with restarts
        after = np.random.get_state()[1].tolist(), random.getstate()  # type: ignore[index]
        assert before == after
        return X

    np.testing.assert_array_equal(run(1), run(2))


@every_baseline
def test_seeds(cls: type[Baseline]) -> None:
    a, b, c, d = (cls(3, seed=s).ask() for s in (0, 1, None, None))
    assert len({x.tobytes() for x in (a, b, c, d)}) == 4
    opt = cls(3)
    np.testing.assert_array_equal(opt.ask(), cls(3, seed=opt.seed).ask())


@every_baseline
def test_foreign_points_are_counted_and_can_be_best_but_do_not_move_the_search(
    cls: type[Baseline],
) -> None:
    ours, theirs = cls(3, seed=2), cls(3, seed=2)
    guess = np.full((1, 3), 0.3)
    theirs.tell(guess, losses=sphere(guess))
    minimize(ours, 50)
    while theirs.evaluations < ours.evaluations + 1:
        X = theirs.ask()
        theirs.tell(X, losses=sphere(X))
    np.testing.assert_array_equal(ours.ask(), theirs.ask())
    assert theirs.best is not None and theirs.best.evaluation == 0
    X = theirs.ask()
    theirs.tell(X, losses=sphere(X))
    count = theirs.evaluations
    theirs.tell(X, losses=sphere(X))  # told twice: the second time they are foreign
    assert theirs.evaluations == count + len(X)


@every_baseline
@pytest.mark.parametrize("share", [0.3, 1.0])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_losses_that_are_no_numbers_rank_last_and_count(
    cls: type[Baseline], share: float, bad: float
) -> None:
    opt = cls(4, seed=0)
    rng = np.random.default_rng(1)
    for _ in range(60):
        X = opt.ask()
        losses = np.where(rng.random(len(X)) < share, bad, sphere(X))
        opt.tell(X, losses=losses)
        assert np.isfinite(opt.ask(opt.popsize)).all()
    assert opt.evaluations == 60 * len(X)
    assert (opt.best is None) if share == 1.0 else (opt.best is not None and opt.best.loss < 0.3)


@every_baseline
@pytest.mark.parametrize("evaluations", [0, 5, 333])
def test_saving_and_loading_continues_bit_for_bit(
    cls: type[Baseline], evaluations: int, tmp_path: Path
) -> None:
    opt = cls(3, np.zeros((4, 4, 3)), seed=7)
    if evaluations:
        images = np.random.default_rng(0).random((2, 4, 4, 3))
        opt.tell(np.random.default_rng(0).random((2, 3)), images)  # foreign
        minimize(opt, evaluations)
    in_flight = opt.ask(2)
    opt.tell(in_flight[1:], losses=[np.nan])
    opt.save(tmp_path / "c")
    again = cls.load(tmp_path / "c")
    assert again.evaluations == opt.evaluations and again.times == opt.times
    for o in (opt, again):
        o.tell(in_flight[:1], losses=[0.25])
    for a, b in zip(minimize(opt, 900), minimize(again, 900), strict=True):
        np.testing.assert_array_equal(a, b)
    assert opt.best is not None and again.best is not None
    assert (again.best.loss, again.best.evaluation) == (opt.best.loss, opt.best.evaluation)
    again.save(tmp_path / "d")
    assert cls.load(tmp_path / "d").evaluations == opt.evaluations


@every_baseline
def test_the_image_of_the_best_is_kept_and_saved(cls: type[Baseline], tmp_path: Path) -> None:
    target = np.random.default_rng(0).random((4, 5, 3)).astype(np.float32)
    opt = cls(2, target, seed=0)
    X = opt.ask()
    images = np.random.default_rng(1).random((len(X), 4, 5, 3)).astype(np.float32)
    images[3] = target
    opt.tell(X, images)
    opt.save(tmp_path / "c")
    for best in (opt.best, cls.load(tmp_path / "c").best):
        assert best is not None and best.image is not None
        assert (best.loss, best.evaluation) == (0.0, 3)
        np.testing.assert_array_equal(best.image, target)
    assert opt.times["encode"] > 0.0


def test_a_callable_loss_is_given_again_when_loading(tmp_path: Path) -> None:
    def brightness(images: Any) -> Any:
        return images.mean(axis=(1, 2, 3))

    opt = Random(2, np.zeros((4, 4, 3)), loss=brightness, seed=0, popsize=3)
    images = np.full((3, 4, 4, 3), 0.5)
    opt.tell(opt.ask(), images)
    opt.save(tmp_path / "c")
    again = Random.load(tmp_path / "c")
    X = again.ask()
    with pytest.raises(LossError, match="give it again"):
        again.tell(X, images)
    assert again.evaluations == 3
    again = Random.load(tmp_path / "c", loss=brightness)
    again.tell(again.ask(), images)
    assert again.best is not None and again.best.loss == 0.5


@every_baseline
def test_a_checkpoint_of_another_optimizer_is_refused(cls: type[Baseline], tmp_path: Path) -> None:
    checkpoint.write(tmp_path / "c", "baseline other", {})
    with pytest.raises(CheckpointError, match="baseline other"):
        cls.load(tmp_path / "c")


@every_baseline
def test_forged_contents_are_refused(cls: type[Baseline], tmp_path: Path) -> None:
    opt = cls(2, seed=0)
    opt.tell(opt.ask(3), losses=np.zeros(3))
    opt.save(tmp_path / "c")
    state = checkpoint.read(tmp_path / "c", f"baseline {cls.name}")
    forgeries: list[dict[str, Any]] = [
        {"losses": np.zeros(1)},
        {"events": np.array([-3, 7])},
        {"events": np.array([-3, 0, 0])},
        {"foreign": None},
        {"options": {"dim": 2, "pickle": "x"}},
        {"options": [2]},
        {"times": 3},
    ]
    for forgery in forgeries:
        checkpoint.write(tmp_path / "c", f"baseline {cls.name}", {**state, **forgery})
        with pytest.raises(CheckpointError, match="impossible contents"):
            cls.load(tmp_path / "c")
    del state["events"]
    checkpoint.write(tmp_path / "c", f"baseline {cls.name}", state)
    with pytest.raises(CheckpointError, match="impossible contents"):
        cls.load(tmp_path / "c")


@every_baseline
def test_bad_input_is_refused_before_anything_changes(cls: type[Baseline]) -> None:
    opt = cls(2, np.zeros((4, 4, 3)), seed=0)
    X = opt.ask()
    cases: list[tuple[type[Exception], str, dict[str, Any]]] = [
        (PointsError, "shape", {"X": X[0], "losses": [1.0]}),
        (PointsError, "shape", {"X": np.zeros((1, 3)), "losses": [1.0]}),
        (PointsError, r"X\[0, 0\] = 2.0", {"X": np.full((1, 2), 2.0), "losses": [1.0]}),
        (PointsError, r"X\[0, 0\] = nan", {"X": np.full((1, 2), np.nan), "losses": [1.0]}),
        (PointsError, "real numbers", {"X": [["a", "b"]], "losses": [1.0]}),
        (LossError, "shape", {"X": X, "losses": [1.0]}),
        (LossError, "neither", {"X": X}),
        (ImageError, "size", {"X": X, "images": np.zeros((len(X), 5, 4, 3))}),
        (ImageError, "1", {"X": X, "images": np.zeros((1, 4, 4, 3)), "losses": np.zeros(len(X))}),
    ]
    for error, match, arguments in cases:
        with pytest.raises(error, match=match):
            opt.tell(**arguments)
    assert opt.evaluations == 0 and opt.best is None
    opt.tell(X, losses=sphere(X))
    assert opt.evaluations == len(X)
    for n in (0, -1, 1.5, True):
        with pytest.raises(OptionError, match="n must be a whole number"):
            opt.ask(n)  # type: ignore[arg-type]


@every_baseline
@pytest.mark.parametrize(
    "options",
    [
        {"dim": 0},
        {"dim": 2.0},
        {"popsize": 0},
        {"popsize": "many"},
        {"sigma0": 0.0},
        {"sigma0": np.nan},
        {"sigma0": "1"},
        {"seed": -1},
        {"seed": "x"},
        {"loss": "none"},
    ],
)
def test_options_out_of_range_are_named(cls: type[Baseline], options: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=next(iter(options))):
        cls(**{"dim": 2, **options})


def test_images_without_a_target_need_losses() -> None:
    opt = Random(2, seed=0)
    X = opt.ask(1)
    with pytest.raises(LossError, match="no target"):
        opt.tell(X, np.zeros((1, 4, 4, 3)))
    opt.tell(X, np.zeros((1, 4, 4, 3)), [0.5])
    assert opt.best is not None and opt.best.image is not None


def test_the_registry_knows_names_and_options(tmp_path: Path) -> None:
    assert {"cma", "fide", "random"} <= set(optimizers.names())
    assert optimizers.options("cma") == ["loss", "popsize", "restarts", "seed", "sigma0"]
    with pytest.raises(UnknownNameError, match=r"known are cma, .*did you mean 'cma'"):
        optimizers.make("cmaes", 2)
    with pytest.raises(OptionError, match="cma has no option 'pop'; its options: loss, popsize"):
        optimizers.make("cma", 2, pop=3)
    opt = optimizers.make("random", 2, seed=1)
    opt.save(tmp_path / "c")
    np.testing.assert_array_equal(optimizers.load("random", tmp_path / "c").ask(), opt.ask())
