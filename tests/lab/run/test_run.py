"""The run loop: what it records, how it resumes, what it refuses."""

from __future__ import annotations

import csv
import json
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fide_lab import run as harness
from fide_lab.baselines.evolution import CMA, Random
from fide_lab.run.loop import PIECE
from fide_plugins.errors import (
    ImageError,
    OptionError,
    UnknownNameError,
)
from fide_plugins.types import Float64

from .tint import TARGET, Tint

pytestmark = pytest.mark.figures


@pytest.mark.parametrize("budget", [1, 5, 33, 200])
@pytest.mark.parametrize("optimizer", ["cma", "random"])
def test_the_budget_is_spent_exactly(optimizer: str, budget: int) -> None:
    task = Tint()
    options = {"popsize": 50}
    result = harness.run(task, optimizer, budget=budget, seed=2, options=options)
    assert result.evaluations == len(result.losses) == len(result.seconds) == budget
    assert len(task.seeds) == len(set(task.seeds)) == budget
    assert task.calls == sum(-(-n // PIECE) for n in [50] * (budget // 50) + [budget % 50])
    assert result.best_loss == result.losses.min()
    assert result.best_evaluation == result.losses.argmin()
    assert (np.diff(result.seconds) >= 0).all() and result.seconds[-1] <= result.wall_s


def test_it_is_the_same_as_asking_and_telling_by_hand() -> None:
    result = harness.run(Tint(), "cma", budget=70, seed=3)
    opt, losses = CMA(3, TARGET, seed=3), []
    while opt.evaluations < 70:
        X = opt.ask()[: 70 - opt.evaluations]
        opt.tell(X, np.broadcast_to(X[:, None, None, :], (len(X), 6, 8, 3)))
        losses += [float(np.square(TARGET - x.astype(np.float32), dtype=float).mean()) for x in X]
    np.testing.assert_allclose(result.losses, losses, rtol=1e-6)
    assert opt.best is not None and result.x_best is not None
    np.testing.assert_array_equal(result.x_best, opt.best.x)


def test_another_loss_is_optimized_and_mse_is_reported() -> None:
    def redness(images: Any) -> Any:
        return -images[..., 0].mean(axis=(1, 2)).astype(float)

    result = harness.run(Tint(), "cma", redness, 150, seed=0)
    assert result.loss == "redness"
    assert result.best_loss < -0.9
    assert result.image is not None
    assert result.mse == pytest.approx(float(np.square(TARGET - result.image).mean()), rel=1e-5)


def test_losses_that_are_not_finite_are_recorded_and_never_best(tmp_path: Path) -> None:
    def broken(images: Any) -> Any:
        values = images.mean(axis=(1, 2, 3)).astype(float)
        return np.where(values < 0.5, np.nan, values)

    result = harness.run(Tint(), "cma", broken, 60, seed=0, out=tmp_path / "a")
    assert np.isnan(result.losses).any() and result.best_loss >= 0.5

    result = harness.run(
        Tint(), "cma", lambda images: [np.inf] * len(images), 20, out=tmp_path / "b"
    )
    assert result.x_best is None and result.summary()["best_loss"] is None
    totals = json.loads((tmp_path / "b" / "run.json").read_text())["totals"]
    assert totals["mse"] is None and totals["x_best"] is None


def test_the_run_directory(tmp_path: Path) -> None:
    out = tmp_path / "runs" / "a"
    result = harness.run("spline", "cma", "mse", 80, 4, size=40, out=out, command=["fide", "a b"])
    assert {p.name for p in out.iterdir()} == {
        "run.json", "curve.csv", "improvements.csv", "best.png", "summary.png", "target.png",
        "target.ckpt", ".run.lock", "run.ckpt", "optimizer-80-4.ckpt",  # 80 of 84: 7 times 12
    }  # fmt: skip
    run = json.loads((out / "run.json").read_text())
    assert run["state"] == "finished" and run["command"] == "fide 'a b'"
    assert run["settings"]["task"] == "spline" and run["settings"]["seed"] == 4
    assert {"python", "numpy", "fide-plugins"} <= set(run["versions"])
    assert run["machine"]["cores"] >= 1
    assert run["totals"].items() >= result.summary().items()
    with open(out / "curve.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["loss"]) for row in rows] == result.losses.tolist()
    best = np.minimum.accumulate(result.losses)
    assert [float(row["best_loss"]) for row in rows] == best.tolist()
    assert [int(row["evaluation"]) for row in rows] == list(range(80))
    with Image.open(out / "best.png") as png:
        assert result.image is not None
        np.testing.assert_array_equal(np.asarray(png), np.rint(result.image * 255).astype(np.uint8))
    with Image.open(out / "summary.png") as png:
        pixels = np.asarray(png.convert("RGB"))
        assert png.width >= 800 and len(np.unique(pixels.reshape(-1, 3), axis=0)) > 50


def test_handlers_of_signals_are_put_back() -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    harness.run(Tint(), "random", budget=3)
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_a_directory_that_cannot_be_written_is_refused_before_rendering(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    task = Tint()
    with pytest.raises(OSError, match="cannot write to the folder"):
        harness.run(task, "random", budget=5, out=tmp_path / "file" / "run")
    assert task.calls == 0


def test_bad_renders_and_settings_are_named(tmp_path: Path) -> None:
    class Wrong(Tint):
        def render(self, X: Float64, seed: Any = None) -> Any:
            return np.zeros((len(X), 5, 8, 3), np.float32)

    with pytest.raises(ImageError):
        harness.run(Wrong(), "random", budget=5)
    with pytest.raises(OptionError, match="budget"):
        harness.run(Tint(), "random", budget=0)
    with pytest.raises(OptionError, match="seed"):
        harness.run(Tint(), "random", seed=-1)
    with pytest.raises(UnknownNameError, match="optimizer"):
        harness.run(Tint(), "none")
    with pytest.raises(UnknownNameError, match="loss"):
        harness.run(Tint(), "random", "none")
    with pytest.raises(ValueError, match="voronoi"):
        harness.run("none", "random")
    with pytest.raises(OptionError, match="its options: device, loss"):
        harness.run(Tint(), "random", options={"epochs": 3}, out=tmp_path / "never")
    with pytest.raises(OptionError, match="seed is an argument of the run"):
        harness.run(Tint(), "random", options={"seed": 3})
    with pytest.raises(OptionError, match="by name"):
        harness.run(Tint(), Random, budget=5, out=tmp_path / "never")
    assert not (tmp_path / "never").exists()
    assert harness.run(Tint(), Random, budget=5).optimizer == "random"


def test_overshooting_renders_warn_once() -> None:
    class Bright(Tint):
        def render(self, X: Float64, seed: Any = None) -> Any:
            return super().render(X, seed) * 2.0

    with pytest.warns(RuntimeWarning) as caught:
        harness.run(Bright(), "random", budget=200)
    assert len(caught) == 1
