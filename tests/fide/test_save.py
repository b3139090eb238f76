"""A saved optimizer goes on bit for bit, and nothing else is taken for one."""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fide_lab.baselines.evolution import Random
from fide_plugins.errors import (
    CheckpointError,
    DeviceError,
    LossError,
    SpaceError,
    UnknownNameError,
)
from fide_plugins.fide import FIDE
from fide_plugins.runtime import checkpoint
from fide_plugins.space import Choice, Float, Group, Space
from fide_plugins.types import Float32, Float64

from .helpers import Render, StateOf

SETTINGS: dict[str, dict[str, Any]] = {
    "linear": {"popsize": 8, "patience": 4},
    "one search, one channel subset": {"popsize": 8, "restarts": "none", "channel_subsets": (3,)},
    "losses only": {"popsize": 8, "proposer": "none"},
    "paper": {"preset": "paper", "popsize": 6, "epochs": 1, "batch_size": 6},
    "other loss and encoder": {"popsize": 8, "loss": "perceptual", "encoder": "patch"},
}


def go_on(opt: FIDE, render: Render, steps: int) -> list[Float64]:
    """Ask and tell in pieces of three, which cut through generations."""
    asked = []
    for _ in range(steps):
        X = opt.ask(3)
        opt.tell(X[::-1], render(X[::-1]))
        asked.append(X)
    return asked


@pytest.mark.parametrize("views", [1, 2])
def test_who_reads_the_best_may_write_to_it(views: int, tmp_path: Path) -> None:
    """In the units of a user, and of a file: a checkpoint must not get what they wrote."""
    opt = FIDE(2, np.zeros((8, 8)) if views == 1 else [np.zeros((8, 8))] * views, seed=0)
    X = opt.ask()
    pictures = [np.full((8, 8), x[0]) for x in X]
    opt.tell(X, pictures if views == 1 else [pictures] * views)
    before, mine = opt.best, opt.solutions()[0]
    assert before is not None
    for read in (opt.best, mine):
        assert read is not None and read.image is not None
        x, pictures = read.x, [read.image] if views == 1 else list(read.image)
        x *= 60
        for picture in pictures:
            picture *= 255
    assert opt.best is not None and opt.best.image is not None and before.image is not None
    np.testing.assert_array_equal(opt.best.x, before.x)
    np.testing.assert_array_equal(opt.best.image, before.image)
    opt.save(tmp_path / "saved")
    again = FIDE.load(tmp_path / "saved").best
    assert again is not None
    np.testing.assert_array_equal(again.x, before.x)


def begun(target: Float32, render: Render, settings: dict[str, Any], steps: int = 20) -> FIDE:
    """In the middle of a generation, with a queue, late ones outside, and an injected one."""
    opt = FIDE(6, target, seed=4, **settings)
    go_on(opt, render, steps)
    opt.ask(2)
    injected = np.full((1, 6), 0.6)
    opt.tell(injected, render(injected))
    return opt


@pytest.mark.parametrize("loss", [sys.float_info.max, -sys.float_info.max, 5e-324])
@pytest.mark.parametrize("proposer", ["linear", "none"])
def test_any_finite_loss_can_be_saved(
    loss: float, proposer: str, target: Float32, render: Render, tmp_path: Path
) -> None:
    """Some tell the largest number there is of a candidate that failed."""
    opt = FIDE(6, target, seed=4, popsize=8, proposer=proposer)
    for _ in range(3):
        X = opt.ask(5)  # results, candidates and an injected candidate are left over
        opt.tell(X, render(X), [loss, 3.0, 1.0, 2.0, 4.0])
        opt.tell([[0.5] * 6], render(X[:1]), [loss])
    opt.save(tmp_path / "c")
    copy = FIDE.load(tmp_path / "c")
    assert copy.best is not None and opt.best is not None and copy.best.loss == opt.best.loss
    np.testing.assert_array_equal(copy.ask(), opt.ask())


@pytest.mark.parametrize("steps", [0, 1, 20])
@pytest.mark.parametrize("what", SETTINGS)
def test_continues_bit_for_bit(
    what: str, steps: int, target: Float32, render: Render, state_of: StateOf, tmp_path: Path
) -> None:
    original = begun(target, render, SETTINGS[what], steps)
    original.save(tmp_path / "c")
    copy = FIDE.load(tmp_path / "c")
    assert state_of(copy) == state_of(original)
    assert copy.times == original.times
    for ours, theirs in zip(go_on(original, render, 14), go_on(copy, render, 14), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert state_of(copy) == state_of(original)
    assert original.best is not None and copy.best is not None
    np.testing.assert_array_equal(original.best.image, copy.best.image)


def test_candidates_that_were_out_may_be_told_to_the_copy(
    target: Float32, render: Render, tmp_path: Path
) -> None:
    original = FIDE(6, target, seed=0, popsize=8)
    X = original.ask()
    original.tell(X[:3], render(X[:3]))
    original.save(tmp_path / "c")
    copy = FIDE.load(tmp_path / "c")
    for opt in (original, copy):
        opt.tell(X[3:], render(X[3:]))
    np.testing.assert_array_equal(original.ask(), copy.ask())
    assert original.evaluations == copy.evaluations == 8


def mse(images: Float32) -> Float64:
    """Has the name of a loss of the library, and is none."""
    values: Float64 = images.mean(axis=(1, 2, 3)).astype(np.float64)
    return values


def test_a_callable_loss_must_be_given_again(
    target: Float32, render: Render, state_of: StateOf, tmp_path: Path
) -> None:
    original = begun(target, render, {"popsize": 8, "loss": mse})
    original.save(tmp_path / "c")
    copy, without = FIDE.load(tmp_path / "c", loss=mse), FIDE.load(tmp_path / "c")
    X = original.ask(3)
    np.testing.assert_array_equal(X, copy.ask(3))
    np.testing.assert_array_equal(X, without.ask(3))
    before = state_of(without)
    with pytest.raises(LossError, match="loss="):
        without.tell(X, render(X))
    assert state_of(without) == before
    for opt in (original, copy):
        opt.tell(X, render(X))
    without.tell(X, render(X), mse(render(X)))
    np.testing.assert_array_equal(original.ask(8), copy.ask(8))
    assert state_of(copy) == state_of(original)
    without.save(tmp_path / "again")
    with pytest.raises(LossError, match="loss="):
        FIDE.load(tmp_path / "again").tell(X, render(X))


def test_a_mistake_in_loading_is_not_the_checkpoint_s(target: Float32, tmp_path: Path) -> None:
    FIDE(3, target).save(tmp_path / "c")
    with pytest.raises(UnknownNameError, match="'l1'"):
        FIDE.load(tmp_path / "c", loss="l1")
    with pytest.raises(DeviceError, match="abacus"):
        FIDE.load(tmp_path / "c", device="abacus")


def test_going_on_asks_for_the_same_arguments(target: Float32, tmp_path: Path) -> None:
    """A checkpoint of another target is whole, and nobody needs to start again."""
    FIDE(6, target, popsize=8, seed=0).save(tmp_path / "a")
    other = FIDE(6, 1 - target, popsize=8, seed=0)
    with pytest.raises(CheckpointError, match="/a: it was saved with another target; give the"):
        other.continue_from(tmp_path / "a")
    assert other.best is None


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.9, 0.999])
def test_cut_short(share: float, target: Float32, render: Render, tmp_path: Path) -> None:
    begun(target, render, {"popsize": 8}).save(tmp_path / "c")
    data = (tmp_path / "c").read_bytes()
    (tmp_path / "c").write_bytes(data[: int(share * len(data))])
    with pytest.raises(CheckpointError, match="cut short"):
        FIDE.load(tmp_path / "c")


def test_changed_foreign_or_of_another_kind(
    target: Float32, render: Render, tmp_path: Path
) -> None:
    begun(target, render, {"popsize": 8}).save(tmp_path / "c")
    data = bytearray((tmp_path / "c").read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "changed").write_bytes(data)
    with pytest.raises(CheckpointError, match="checksum"):
        FIDE.load(tmp_path / "changed")
    (tmp_path / "text").write_text("hello")
    with pytest.raises(CheckpointError, match="not a FIDE checkpoint"):
        FIDE.load(tmp_path / "text")
    Random(3, seed=0).save(tmp_path / "random")
    with pytest.raises(CheckpointError, match="it holds a 'random', not a 'fide'"):
        FIDE.load(tmp_path / "random")
    with pytest.raises(FileNotFoundError):
        FIDE.load(tmp_path / "absent")


def with_entry(saved: Any, place: str, value: object) -> dict[str, Any]:
    """A copy of a checkpoint with another value at a place, such as "state.best"."""
    head, _, rest = place.partition(".")
    return {**saved, head: with_entry(saved[head], rest, value) if rest else value}


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("settings", None),
        ("settings.surprise", 1),
        ("settings.dim", "six"),
        ("settings.target", np.zeros(3)),
        ("loss", "surprise"),
        ("state", None),
        ("state.surprise", 1),
        ("state.rng", {}),
        ("state.search", None),
        ("state.population", {"size": 8}),
        ("state.proposer", None),
        ("state.best", {"y": 1}),
        ("state.samples", [{"index": 1}]),
        ("state.relocation", []),
        ("state.gate", {}),
        ("state.stage", "rest"),
        ("state.search_best", {"x": 0}),
        ("state.versions", None),
    ],
)
def test_impossible_contents(
    place: str, value: object, target: Float32, render: Render, tmp_path: Path
) -> None:
    """A file with the right checksum that somebody else wrote."""
    begun(target, render, {"popsize": 8}).save(tmp_path / "c")
    saved = checkpoint.read(tmp_path / "c", "fide")
    checkpoint.write(tmp_path / "c", "fide", with_entry(saved, place, value))
    with pytest.raises(CheckpointError, match="impossible contents"):
        FIDE.load(tmp_path / "c")


@pytest.mark.parametrize("part", ["search", "population", "moves", "proposer"])
def test_a_part_of_another_dimension(
    part: str, target: Float32, render: Render, tmp_path: Path
) -> None:
    for name, dim in (("c", 6), ("other", 5)):
        opt = FIDE(dim, target, popsize=8, seed=0)
        for _ in range(3):
            X = opt.ask(9)
            opt.tell(X, render(X))
        opt.save(tmp_path / name)
    saved, other = (checkpoint.read(tmp_path / name, "fide") for name in ("c", "other"))
    odd = with_entry(saved, f"state.{part}", other["state"][part])
    checkpoint.write(tmp_path / "c", "fide", odd)
    with pytest.raises(CheckpointError, match="impossible contents"):
        FIDE.load(tmp_path / "c")


@pytest.mark.parametrize(
    ("place", "version", "message"),
    [
        ("encoder", "dense-0", r"encoder dense-0; the one here is dense-\d: take the version"),
        ("loss", "mse-0", r"loss mse-0; the one here is mse-\d: take the version .*start again$"),
    ],
)
def test_another_version(
    place: str, version: str, message: str, target: Float32, render: Render, tmp_path: Path
) -> None:
    begun(target, render, {"popsize": 8}).save(tmp_path / "c")
    saved = checkpoint.read(tmp_path / "c", "fide")
    checkpoint.write(tmp_path / "c", "fide", with_entry(saved, f"state.versions.{place}", version))
    with pytest.raises(CheckpointError, match=message) as caught:
        FIDE.load(tmp_path / "c")
    assert "impossible contents" not in str(caught.value)
    if place == "loss":
        FIDE.load(tmp_path / "c", loss=mse)  # a loss of one's own has no versions


def test_a_missing_entry(target: Float32, render: Render, tmp_path: Path) -> None:
    """Options aside, which have defaults."""
    begun(target, render, {"popsize": 8}).save(tmp_path / "c")
    saved = checkpoint.read(tmp_path / "c", "fide")
    needed = {
        "settings": ("dim", "target", "x0", "sigma0", "seed", "popsize"),
        "state": tuple(saved["state"]),
    }
    without = {place: {k: v for k, v in saved.items() if k != place} for place in saved}
    for name, places in needed.items():
        for place in places:
            rest = {k: v for k, v in saved[name].items() if k != place}
            without[f"{name}.{place}"] = {**saved, name: rest}
    accepted = []
    for place, odd in without.items():
        checkpoint.write(tmp_path / "d", "fide", odd)
        try:
            FIDE.load(tmp_path / "d")
            accepted.append(place)
        except CheckpointError as error:
            assert "impossible contents" in str(error)
    assert not accepted


def test_the_target_of_a_checkpoint_is_no_path(target: Float32, tmp_path: Path) -> None:
    """A file that somebody else wrote does not say which files are opened here."""
    picture = tmp_path / "target.png"
    Image.fromarray((255 * target).astype(np.uint8)).save(picture)
    FIDE(3, picture, seed=0).save(tmp_path / "c")
    saved = checkpoint.read(tmp_path / "c", "fide")
    checkpoint.write(tmp_path / "c", "fide", with_entry(saved, "settings.target", str(picture)))
    with pytest.raises(CheckpointError, match="impossible contents"):
        FIDE.load(tmp_path / "c")


def test_a_directory_that_cannot_be_written(target: Float32, tmp_path: Path) -> None:
    opt = FIDE(3, target, seed=0)
    with pytest.raises(OSError, match="absent"):
        opt.save(tmp_path / "absent" / "c")
    opt.save(tmp_path / "c")
    before = (tmp_path / "c").read_bytes()
    with pytest.raises(OSError):
        opt.save(tmp_path)
    assert (tmp_path / "c").read_bytes() == before
    assert os.listdir(tmp_path) == ["c"]


def test_a_state_that_is_none_leaves_the_optimizer_as_it_was(
    target: Float32, render: Render, state_of: StateOf
) -> None:
    """Also one whose last parts are wrong, when all others could be loaded."""
    opt, other = (begun(target, render, {"popsize": 8}) for _ in range(2))
    go_on(other, render, 9)
    before, held = state_of(opt), opt.state
    for place in ("best", "searches", "proposer", "gate", "search_best", "times"):
        state = dict(other.state_dict(), **{place: "nothing of the kind"})
        with pytest.raises((ValueError, TypeError, KeyError)):
            opt.load_state_dict(state)
        assert opt.state is held and state_of(opt) == before
    same = begun(target, render, {"popsize": 8})
    np.testing.assert_array_equal(go_on(opt, render, 5), go_on(same, render, 5))


def test_loading_waits_for_who_asks_or_tells(target: Float32, render: Render) -> None:
    opt = begun(target, render, {"popsize": 8})
    state = opt.state_dict()
    thread = threading.Thread(target=opt.load_state_dict, args=(state,))
    with opt._lock:
        held = opt.state
        thread.start()
        thread.join(0.2)
        assert thread.is_alive() and opt.state is held
    thread.join()
    assert opt.state is not held


def test_values_that_no_file_can_hold_are_refused_before_anything_is_written(
    target: Float32, render: Render, tmp_path: Path
) -> None:
    odd = Space(x=Group(a=Float(0, 1), color=Choice((255, 0, 0), (0, 0, 255))))
    opt = FIDE(odd, target, seed=0)
    path = tmp_path / "c"
    path.write_text("an earlier one")
    with pytest.raises(SpaceError, match=r"'x.color' has the value \(255, 0, 0\).*use texts"):
        opt.save(path)
    assert path.read_text() == "an earlier one" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("state", [{}, {"versions": {}}, {"versions": None}, None])
def test_what_is_no_state_is_a_value_error(target: Float32, state: Any) -> None:
    with pytest.raises(ValueError):
        FIDE(6, target).load_state_dict(state)


def test_two_optimizers_of_one_state_have_their_own_times(target: Float32, render: Render) -> None:
    opt = begun(target, render, {"popsize": 8})
    held = opt.state_dict()
    seconds = dict(held["times"])
    other = FIDE(6, target, popsize=8)
    other.load_state_dict(held)
    go_on(opt, render, 3)
    assert held["times"] == other.times == seconds != opt.times
