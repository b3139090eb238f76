"""Saving and loading, for every baseline."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab import optimizers
from fide_lab.baselines.evolution import Random
from fide_plugins import losses as losses_module
from fide_plugins.encoders.patch import RawPatchEncoder
from fide_plugins.errors import CheckpointError, DeviceError, LossError, UnknownNameError
from fide_plugins.losses.mse import MeanSquaredError
from fide_plugins.runtime import checkpoint

Subject = Any  # of conftest.py


@pytest.mark.thorough
@pytest.mark.parametrize("share", [0.0, 0.02, 1.0])
def test_saving_and_loading_continues_bit_for_bit(
    subject: Subject, share: float, tmp_path: Path
) -> None:
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
    for best in (opt.best, subject.load(tmp_path / "c").best):
        assert best is not None and best.image is not None
        assert (best.loss, best.evaluation) == (0.0, len(X) - 1)
        np.testing.assert_array_equal(best.image, opt.target)
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


def test_loading_builds_the_loss_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opt = Random(2, np.zeros((4, 4, 3)), seed=0)
    opt.save(tmp_path / "c")
    made: list[str] = []

    def counted(target: object) -> Any:
        made.append("mse")
        return MeanSquaredError(target)

    monkeypatch.setitem(losses_module._REGISTRY._factories, "counted", counted)
    again = Random.load(tmp_path / "c", loss="counted")
    assert made == ["mse"] and again.loss_name == "counted"


def test_the_name_of_a_loss_is_kept_without_a_target(tmp_path: Path) -> None:
    opt = Random(2, loss="perceptual", seed=0)
    opt.save(tmp_path / "c")
    assert Random.load(tmp_path / "c").loss_name == "perceptual"
    with pytest.raises(UnknownNameError, match="known are"):
        Random.load(tmp_path / "c", loss="percptual")


def test_a_device_that_is_not_there_is_refused(subject: Subject, tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match="no device 'nowhere'"):
        subject.make(2, device="nowhere")
    subject.make(2, seed=0).save(tmp_path / "c")
    with pytest.raises(DeviceError, match="no device 'nowhere'"):
        type(subject.make(2)).load(tmp_path / "c", device="nowhere")


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
    (("state", "network"), LACKING),
    (("state",), LACKING),
]


def test_forged_contents_are_refused(subject: Subject, tmp_path: Path) -> None:
    opt = subject.make(2, seed=0)
    subject.tell(opt, opt.ask(3), np.array([0.5, 0.25, 0.75]))
    opt.save(tmp_path / "c")
    whole = checkpoint.read(tmp_path / "c", subject.name)
    network = [] if whole["state"]["network"] is None else [(("state", "network"), "x")]
    for path, value in [*FORGERIES, *network]:
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
