"""A saved optimizer goes on bit for bit, and nothing else is taken for one."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest

from fide_plugins import checkpoint
from fide_plugins.baselines.random import Random
from fide_plugins.errors import CheckpointError, DeviceError, LossError, UnknownNameError
from fide_plugins.fide import FIDE
from fide_plugins.images import Float32
from fide_plugins.points import Float64

Render: TypeAlias = Callable[[Float64], Float32]
StateOf: TypeAlias = Callable[[FIDE], bytes]

SETTINGS: dict[str, dict[str, Any]] = {
    "linear": {"popsize": 8, "patience": 4},
    "one search, one view": {"popsize": 8, "restarts": "none", "views": (3,)},
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


def begun(target: Float32, render: Render, settings: dict[str, Any], steps: int = 20) -> FIDE:
    """In the middle of a generation, with a queue, late candidates outside, and a guest."""
    opt = FIDE(6, target, seed=4, **settings)
    go_on(opt, render, steps)
    opt.ask(2)
    guest = np.full((1, 6), 0.6)
    opt.tell(guest, render(guest))
    return opt


@pytest.mark.parametrize("loss", [sys.float_info.max, -sys.float_info.max, 5e-324])
@pytest.mark.parametrize("proposer", ["linear", "none"])
def test_any_finite_loss_can_be_saved(
    loss: float, proposer: str, target: Float32, render: Render, tmp_path: Path
) -> None:
    """Some tell the largest number there is of a candidate that failed."""
    opt = FIDE(6, target, seed=4, popsize=8, proposer=proposer)
    for _ in range(3):
        X = opt.ask(5)  # lessons, candidates and a guest are left over
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


def test_saving_changes_nothing(target: Float32, render: Render, tmp_path: Path) -> None:
    saved, other = (begun(target, render, {"popsize": 8}) for _ in range(2))
    for i in range(3):
        saved.save(tmp_path / "c")
        a, b = go_on(saved, render, 2), go_on(other, render, 2)
        np.testing.assert_array_equal(a, b, err_msg=str(i))


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


def test_before_anything_was_told(target: Float32, tmp_path: Path) -> None:
    original = FIDE(3, target)  # a seed of its own
    original.save(tmp_path / "c")
    np.testing.assert_array_equal(FIDE.load(tmp_path / "c").ask(), original.ask())


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
    with pytest.raises(CheckpointError, match="kind"):
        FIDE.load(tmp_path / "random")
    with pytest.raises(FileNotFoundError):
        FIDE.load(tmp_path / "absent")


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("options", None),
        ("options", {"surprise": 1}),
        ("dim", "six"),
        ("target", np.zeros(3)),
        ("rng", {}),
        ("search", None),
        ("ledger", {"popsize": 8}),
        ("proposer", None),
        ("best", {"y": 1}),
        ("lessons", [{"index": 1}]),
        ("relocation", []),
        ("stage", "rest"),
        ("found", {"x": 0}),
    ],
)
def test_impossible_contents(
    place: str, value: object, target: Float32, render: Render, tmp_path: Path
) -> None:
    """A file with the right checksum that somebody else wrote."""
    begun(target, render, {"popsize": 8}).save(tmp_path / "c")
    state = checkpoint.read(tmp_path / "c", "fide")
    checkpoint.write(tmp_path / "c", "fide", state | {place: value})
    with pytest.raises(CheckpointError, match="impossible contents"):
        FIDE.load(tmp_path / "c")


def test_a_search_of_another_dimension(target: Float32, render: Render, tmp_path: Path) -> None:
    for name, dim in (("c", 6), ("other", 5)):
        FIDE(dim, target, popsize=8, seed=0).save(tmp_path / name)
    state, other = (checkpoint.read(tmp_path / name, "fide") for name in ("c", "other"))
    checkpoint.write(tmp_path / "c", "fide", state | {"search": other["search"]})
    with pytest.raises(CheckpointError, match="impossible contents"):
        FIDE.load(tmp_path / "c")


@pytest.mark.parametrize(
    ("place", "version", "message"),
    [
        ("encoder", "dense-0", r"encoder dense-0; the one here is dense-\d"),
        ("loss_version", "mse-0", r"loss mse-0; the one here is mse-\d"),
    ],
)
def test_another_version(
    place: str, version: str, message: str, target: Float32, render: Render, tmp_path: Path
) -> None:
    begun(target, render, {"popsize": 8}).save(tmp_path / "c")
    state = checkpoint.read(tmp_path / "c", "fide")
    checkpoint.write(tmp_path / "c", "fide", state | {place: version})
    with pytest.raises(CheckpointError, match=message):
        FIDE.load(tmp_path / "c")
    if place == "loss_version":
        FIDE.load(tmp_path / "c", loss=mse)  # a loss of one's own has no versions


def test_a_missing_entry(target: Float32, render: Render, tmp_path: Path) -> None:
    begun(target, render, {"popsize": 8}).save(tmp_path / "c")
    state = checkpoint.read(tmp_path / "c", "fide")
    for place in state:
        checkpoint.write(tmp_path / "d", "fide", {k: v for k, v in state.items() if k != place})
        with pytest.raises(CheckpointError, match="impossible contents"):
            FIDE.load(tmp_path / "d")


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
