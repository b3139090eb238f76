"""What every baseline keeps: ask and tell, bounds, seeds, budgets, saving, errors."""

from __future__ import annotations

import os
import random
import signal
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from fide_lab import optimizers, run as harness
from fide_lab.baselines.evolution import Random
from fide_plugins.encoders.patch import RawPatchEncoder
from fide_plugins.errors import (
    CheckpointError,
    DeviceError,
    ImageError,
    LossError,
    OptionError,
    PointsError,
    UnknownNameError,
)
from fide_plugins.runtime import checkpoint
from fide_plugins.space import Float, Int, Space
from fide_plugins.types import Float64

from .conftest import render, sphere, target as picture
from .small import OPTIONS

Subject = Any  # of conftest.py
NOT_RESUMABLE = ("fide-annealing", "inverse", "sge")


def test_all_baselines_are_tested(subjects: list[Subject]) -> None:
    tested = {subject.name for subject in subjects}
    assert set(optimizers.names()) - {"fide"} <= tested
    assert {name.partition(":")[0] for name in tested if ":" in name} == {"nevergrad", "optuna"}


@pytest.mark.parametrize("dim", [1, 4])
def test_candidates_lie_in_the_box_and_the_best_is_kept(subject: Subject, dim: int) -> None:
    opt = subject.make(dim, seed=1)
    assert opt.best is None
    assert opt.recommend().shape == (dim,)
    np.testing.assert_allclose(opt.recommend(), 0.5, atol=0.3)
    X = np.concatenate(subject.minimize(opt, subject.evaluations))
    assert X.dtype == np.float64 and X.shape == (opt.evaluations, dim)
    assert X.min() >= 0.0 and X.max() <= 1.0
    losses = sphere(X)
    assert opt.best is not None
    assert opt.best.evaluation == losses.argmin()
    assert opt.best.loss == losses.min()
    np.testing.assert_array_equal(opt.best.x, X[losses.argmin()])
    assert opt.recommend().min() >= 0.0 and opt.recommend().max() <= 1.0


def test_pieces_and_order_do_not_matter(subject: Subject) -> None:
    whole, pieces = subject.make(5, seed=3), subject.make(5, seed=3)
    rng = np.random.default_rng(0)
    for X in subject.minimize(whole, subject.evaluations // 2):
        n = len(X)
        Y = np.concatenate([pieces.ask(1), *([pieces.ask(2)] if n > 3 else [])])
        while len(Y) < n:
            Y = np.concatenate([Y, pieces.ask()])
        np.testing.assert_array_equal(X, Y)
        for part in np.array_split(rng.permutation(n), min(n, 3)):
            subject.tell(pieces, Y[part])
    np.testing.assert_array_equal(whole.ask(), pieces.ask())


def test_many_workers_with_late_results(subject: Subject) -> None:
    opt = subject.make(4, seed=0)
    waiting = opt.ask(3 * opt.popsize + 1)
    rng = np.random.default_rng(0)
    evaluations = 400 if subject.name == "cma" else 100
    for _ in range(evaluations):
        i = int(rng.integers(len(waiting)))
        subject.tell(opt, waiting[i : i + 1])
        waiting = np.concatenate([np.delete(waiting, i, axis=0), opt.ask(1)])
    assert opt.evaluations == evaluations
    assert opt.best is not None and opt.best.loss < subject.close


def test_global_random_state_is_neither_read_nor_changed(subject: Subject) -> None:
    def state() -> tuple[Any, ...]:
        numpys: Any = np.random.get_state()
        return numpys[1].tolist(), numpys[2], random.getstate(), torch.get_rng_state().tolist()

    def run(global_seed: int) -> Float64:
        np.random.seed(global_seed)
        random.seed(global_seed)
        torch.manual_seed(global_seed)
        before = state()
        X = np.concatenate(subject.minimize(subject.make(3, seed=5), subject.evaluations))
        assert state() == before
        return X

    np.testing.assert_array_equal(run(1), run(2))


class Bright:
    """A task of the pictures of `conftest`, which Ctrl-C can stop at a render."""

    dim, target = 3, picture()

    def __init__(self, stop_at: int = -1) -> None:
        self.renders, self.stop_at = 0, stop_at

    def render(self, X: Float64, seed: Any = None) -> Any:
        self.renders += len(X)
        if 0 < self.stop_at <= self.renders:
            self.stop_at = -1
            os.kill(os.getpid(), signal.SIGINT)
        return render(X)


def test_a_run_has_its_budget_also_if_it_was_interrupted(subject: Subject, tmp_path: Path) -> None:
    options = {k: v for k, v in OPTIONS.get(subject.name, {}).items() if k != "budget"}
    settings: dict[str, Any] = {"budget": 45, "seed": 3, "options": options}
    whole = harness.run(Bright(), subject.name, **settings)
    assert whole.evaluations == 45
    with pytest.raises(harness.Interrupted):
        harness.run(Bright(stop_at=23), subject.name, **settings, out=tmp_path / "run")
    if subject.name in NOT_RESUMABLE:
        with pytest.raises(CheckpointError, match="cannot be resumed"):
            harness.run(Bright(), subject.name, **settings, out=tmp_path / "run", resume=True)
        return
    resumed = harness.run(Bright(), subject.name, **settings, out=tmp_path / "run", resume=True)
    np.testing.assert_array_equal(resumed.losses, whole.losses)


def test_injected_points_are_counted_and_can_be_best_but_do_not_move_the_search(
    subject: Subject,
) -> None:
    ours, theirs = subject.make(3, seed=2), subject.make(3, seed=2)
    guess = np.full((1, 3), 0.3)
    subject.tell(theirs, guess)
    subject.minimize(ours, 25)
    while theirs.evaluations < ours.evaluations + 1:
        subject.tell(theirs, theirs.ask())
    np.testing.assert_array_equal(ours.ask(), theirs.ask())
    assert theirs.best is not None and theirs.best.evaluation == 0
    X = theirs.ask()
    subject.tell(theirs, X)
    count = theirs.evaluations
    subject.tell(theirs, X)  # told twice: the second time they are injected
    assert theirs.evaluations == count + len(X)


@pytest.mark.thorough
@pytest.mark.parametrize(("share", "bad"), [(0.3, np.nan), (1.0, np.inf), (0.5, -np.inf)])
def test_losses_that_are_no_numbers_rank_last_and_count(
    subject: Subject, share: float, bad: float
) -> None:
    opt = subject.make(4, seed=0)
    rng = np.random.default_rng(1)
    lowest = np.inf
    while opt.evaluations < subject.evaluations:
        X = opt.ask()
        losses = np.where(rng.random(len(X)) < share, bad, sphere(X))
        lowest = min(lowest, np.min(losses[np.isfinite(losses)], initial=np.inf))
        count = opt.evaluations
        subject.tell(opt, X, losses)
        assert opt.evaluations == count + len(X)
        assert np.isfinite(opt.ask(opt.popsize)).all()
    assert (opt.best is None) if share == 1.0 else (opt.best is not None)
    assert opt.best is None or opt.best.loss == lowest


def test_no_thread_outlives_its_baseline(subject: Subject) -> None:
    before = set(threading.enumerate())  # some of earlier tests may end meanwhile
    opt = subject.make(2, seed=0)
    subject.minimize(opt, 10)
    own = set(threading.enumerate()) - before
    assert len(own) == subject.threads
    del opt
    assert not own & set(threading.enumerate())


def test_bad_input_is_refused_before_anything_changes(subject: Subject) -> None:
    opt = subject.make(2, seed=0)
    X = opt.ask()
    images = subject.render(X)
    cases: list[tuple[type[Exception], str, dict[str, Any]]] = [
        (PointsError, "shape", {"X": X[0], "losses": [1.0]}),
        (PointsError, "shape", {"X": np.zeros((1, 3)), "losses": [1.0]}),
        (PointsError, r"X\[0, 0\] = 2.0", {"X": np.full((1, 2), 2.0), "losses": [1.0]}),
        (PointsError, r"X\[0, 0\] = nan", {"X": np.full((1, 2), np.nan), "losses": [1.0]}),
        (PointsError, "real numbers", {"X": [["a", "b"]], "losses": [1.0]}),
        (LossError, "shape", {"X": X, "images": images, "losses": [1.0, 2.0] * len(X)}),
        (LossError, "neither", {"X": X}),
        (ImageError, "size", {"X": X, "images": np.zeros((len(X), 5, 4, 3))}),
        (
            ImageError,
            "one image per point",
            {"X": X, "images": np.zeros((len(X) + 1, 16, 16, 3)), "losses": np.zeros(len(X))},
        ),
    ]
    if subject.looks:
        cases.append((ImageError, "learns from images", {"X": X, "losses": sphere(X)}))
    for error, match, arguments in cases:
        with pytest.raises(error, match=match):
            opt.tell(**arguments)
    assert opt.evaluations == 0 and opt.best is None
    subject.tell(opt, X)
    assert opt.evaluations == len(X)
    for n in (0, -1, 1.5, True):
        with pytest.raises(OptionError, match="n must be a whole number"):
            opt.ask(n)


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
    ids=str,
)
def test_options_out_of_range_are_named(subject: Subject, options: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=next(iter(options))):
        subject.make(**{"dim": 2, **options})


def test_those_that_look_at_images_need_a_target(subjects: list[Subject]) -> None:
    for subject in subjects:
        if subject.looks:
            with pytest.raises(ImageError, match="needs a target"):
                optimizers.make(subject.name, 2)


def test_images_without_a_target_need_losses() -> None:
    opt = Random(2, seed=0)
    X = opt.ask(1)
    with pytest.raises(LossError, match="no target"):
        opt.tell(X, np.zeros((1, 4, 4, 3)))
    opt.tell(X, np.zeros((1, 4, 4, 3)), [0.5])
    assert opt.best is not None and opt.best.image is not None


def test_the_registry_knows_names_and_options(tmp_path: Path) -> None:
    assert {"cma", "fide", "random"} <= set(optimizers.names())
    assert optimizers.options("cma") == ["device", "loss", "popsize", "restarts", "seed", "sigma0"]
    with pytest.raises(UnknownNameError, match=r"known are cma, .*did you mean 'cma'"):
        optimizers.make("cmaes", 2)
    with pytest.raises(OptionError, match="cma has no option 'pop'; its options: device, loss"):
        optimizers.make("cma", 2, pop=3)
    opt = optimizers.make("random", 2, seed=1)
    opt.save(tmp_path / "c")
    np.testing.assert_array_equal(optimizers.load("random", tmp_path / "c").ask(), opt.ask())


class TakesSpaces(Random):
    """An optimizer that sees names and kinds of the parameters."""

    takes_space = True

    def __init__(self, space: Any, target: object = None, **options: Any) -> None:
        super().__init__(space.dim, target, **options)
        self.space = space


def a_function(dim: int, target: object = None, *, seed: int = 0) -> Random:
    return Random(dim, target, seed=seed)


def test_functions_and_classes_that_take_a_space_can_be_registered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(optimizers._REGISTRY, "_factories", {})
    optimizers.register("function", a_function)
    optimizers.register("spaces", TakesSpaces)
    space = Space(a=Float(0, 1), b=Int(0, 3))
    assert optimizers.options("function") == ["seed"]
    assert optimizers.make("function", space, seed=3).ask().shape[1] == 2
    with pytest.raises(OptionError, match="no option 'sed'"):
        optimizers.make("function", 2, sed=3)
    made: Any = optimizers.make("spaces", space, seed=3)
    assert made.space is space and made.dim == 2


# -- saving ----------------------------------------------------------------------------------------


@pytest.mark.thorough
@pytest.mark.parametrize("share", [0.0, 0.02, 1.0])
def test_saving_and_loading_continues_bit_for_bit(
    subject: Subject, share: float, tmp_path: Path
) -> None:
    if subject.name in NOT_RESUMABLE:
        pytest.skip("it cannot be loaded")
    opt = subject.make(3, seed=7)
    if share:
        subject.tell(opt, np.random.default_rng(0).random((2, 3)))  # injected
        subject.minimize(opt, int(share * subject.evaluations))
    in_flight = opt.ask(2)
    subject.tell(opt, in_flight[1:], np.array([np.nan]))
    opt.save(tmp_path / "c")
    again = subject.load(tmp_path / "c")
    assert again.evaluations == opt.evaluations and again.times == opt.times
    for o in (opt, again):
        subject.tell(o, in_flight[:1], np.array([0.25]))
    more = opt.evaluations + subject.evaluations // 2
    for a, b in zip(subject.minimize(opt, more), subject.minimize(again, more), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(opt.recommend(), again.recommend())
    assert opt.best is not None and again.best is not None
    assert (again.best.loss, again.best.evaluation) == (opt.best.loss, opt.best.evaluation)
    again.save(tmp_path / "d")
    assert subject.load(tmp_path / "d").evaluations == opt.evaluations


def test_the_image_of_the_best_is_kept_and_saved(subject: Subject, tmp_path: Path) -> None:
    opt = subject.make(3, seed=0)
    X = opt.ask()
    images = subject.render(X)
    assert opt.target is not None
    images[-1] = opt.target
    opt.tell(X, images)
    opt.save(tmp_path / "c")
    saved = [] if subject.name in NOT_RESUMABLE else [subject.load(tmp_path / "c").best]
    for best in (opt.best, *saved):
        assert best is not None and best.image is not None
        assert (best.loss, best.evaluation) == (0.0, len(X) - 1)
        np.testing.assert_array_equal(best.image, opt.target)
    assert opt.times["encode"] > 0.0


def test_a_device_that_is_not_there_is_refused(subject: Subject) -> None:
    with pytest.raises(DeviceError, match="no device 'nowhere'"):
        subject.make(2, device="nowhere")


def test_a_checkpoint_of_another_optimizer_is_refused(subject: Subject, tmp_path: Path) -> None:
    checkpoint.write(tmp_path / "c", "other", {})
    with pytest.raises(CheckpointError, match="other"):
        subject.load(tmp_path / "c")


def test_features_of_another_version_of_the_encoder_are_refused(
    subject: Subject, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "encoder" not in optimizers.options(subject.name):
        pytest.skip("it has no encoder")
    opt = subject.make(3, seed=0, encoder="patch")
    subject.tell(opt, opt.ask())
    opt.save(tmp_path / "c")
    monkeypatch.setattr(RawPatchEncoder, "version", "patch-2")
    message = r"features of the encoder patch-1; the one here is patch-2: take .*or start again"
    for load in (subject.load, subject.make(3, seed=0, encoder="patch").continue_from):
        with pytest.raises(CheckpointError, match=message):
            load(tmp_path / "c")


LACKING = object()
FORGERIES: list[tuple[tuple[str, ...], Any]] = [
    (("settings",), [2]),
    (("settings", "pickle"), "x"),
    (("settings", "dim"), 2**40),
    (("state", "times"), 3),
    (("state", "evaluations"), -1),
    (("state", "best", "x"), np.zeros(3)),
    (("state", "best", "loss"), np.nan),
    *((("state", "events"), np.array(e)) for e in ([-3, 7], [-3, 0, 0], [-4, 0, 1], [0.5, 1.0])),
    (("state", "losses"), np.zeros(1)),
    (("state", "injected"), None),
    (("state", "asked"), "x"),
    (("state",), LACKING),
]


def test_forged_contents_are_refused(subject: Subject, tmp_path: Path) -> None:
    if subject.name in NOT_RESUMABLE:
        pytest.skip("it cannot be loaded")
    opt = subject.make(2, seed=0)
    subject.tell(opt, opt.ask(3), np.array([0.5, 0.25, 0.75]))
    opt.save(tmp_path / "c")
    whole = checkpoint.read(tmp_path / "c", subject.name)
    for path, value in FORGERIES:
        checkpoint.write(tmp_path / "c", subject.name, changed(whole, path, value))
        with pytest.raises(CheckpointError, match="impossible contents"):
            subject.load(tmp_path / "c")


def changed(state: dict[str, Any], path: tuple[str, ...], value: Any) -> dict[str, Any]:
    """The state with another value at a place, or without one."""
    name, *rest = path
    if rest:
        return {**state, name: changed(state[name], tuple(rest), value)}
    without = {key: kept for key, kept in state.items() if key != name}
    return without if value is LACKING else {**without, name: value}
