"""What a run records beside the losses: other losses, checksums."""

from __future__ import annotations

import csv
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab import optimizers, run as harness
from fide_lab.baselines.evolution import Random
from fide_lab.run import Keep
from fide_plugins import losses
from fide_plugins.errors import PointsError
from fide_plugins.types import Float64

TARGET = np.random.default_rng(0).random((6, 8, 3)).astype(np.float32)
KEEP = Keep(metrics=("mse", "loi"), summary=False, checkpoint=False)


class Tint:
    """A plain color; it remembers every image, and can be told to stop the run."""

    name, dim, seed, target = "tint", 3, 5, TARGET

    def __init__(self, stop_at: int = -1) -> None:
        self.images: list[Any] = []
        self.calls, self.stop_at = 0, stop_at

    def render(self, X: Float64, seed: Any = None) -> Any:
        self.calls += 1
        if self.calls == self.stop_at:
            os.kill(os.getpid(), signal.SIGINT)
        images = np.broadcast_to(X[:, None, None, :], (len(X), 6, 8, 3)).astype(np.float32)
        self.images += list(images)
        return images


def test_every_improvement_is_measured_by_the_other_losses(tmp_path: Path) -> None:
    task = Tint()
    result = harness.run(task, "cma", "mse", 90, seed=2, out=tmp_path, keep=KEEP)
    best = np.minimum.accumulate(result.losses)
    expected = [i for i in range(90) if i == 0 or best[i] < best[i - 1]]
    assert result.improvements.tolist() == expected
    images = np.array([task.images[i] for i in expected])
    for name in ("mse", "loi"):
        by_hand = losses.make(name, TARGET)(images)
        np.testing.assert_allclose(result.metrics[name], by_hand, rtol=1e-6)
        assert result.judged[name] == pytest.approx(by_hand[-1], rel=1e-6)
    with open(tmp_path / "improvements.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["evaluation"]) for row in rows] == expected
    assert [float(row["loss"]) for row in rows] == result.losses[expected].tolist()
    assert [float(row["loi"]) for row in rows] == result.metrics["loi"].tolist()


def test_all_of_it_survives_an_interruption(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"budget": 230, "seed": 1, "options": {"popsize": 70}, "keep": KEEP}
    harness.run(Tint(), "cma", **settings, out=tmp_path / "whole")
    with pytest.raises(harness.Interrupted):
        harness.run(Tint(stop_at=5), "cma", **settings, out=tmp_path / "halves")
    assert (tmp_path / "halves" / "run.ckpt").exists()
    harness.run(Tint(), "cma", **settings, out=tmp_path / "halves", resume=True)
    names = sorted(p.name for p in (tmp_path / "whole").iterdir())
    assert names == sorted(p.name for p in (tmp_path / "halves").iterdir())
    assert "run.ckpt" not in names and "summary.png" not in names
    for name in (name for name in names if name.endswith(".png")):
        whole, halves = (tmp_path / run / name for run in ("whole", "halves"))
        assert whole.read_bytes() == halves.read_bytes()
    tables = [(tmp_path / run / "improvements.csv").read_text() for run in ("whole", "halves")]
    without_seconds = [[row.split(",")[::2] for row in table.splitlines()] for table in tables]
    assert without_seconds[0] == without_seconds[1]


@pytest.mark.parametrize(
    ("candidates", "message"),
    [
        (np.full((4, 3), np.nan), "X\\[0, 0\\] = nan"),
        (np.full((4, 3), 1.5), "lie in \\[0, 1\\]"),
        (np.zeros((4, 2)), "the shape \\(n, 3\\)"),
        (np.zeros((0, 3)), "at least one"),
        (None, "real numbers"),
    ],
)
def test_an_optimizer_that_leaves_the_box_is_named(candidates: Any, message: str) -> None:
    class Astray(Random):
        def ask(self, n: int | None = None) -> Any:
            return candidates

    optimizers.register("astray", Astray)
    try:
        task = Tint()
        with pytest.raises(PointsError, match=f"astray asked for impossible.*{message}"):
            harness.run(task, "astray", budget=20)
        assert task.calls == 0
    finally:
        optimizers._REGISTRY._factories.pop("astray")


def test_other_metrics_are_another_run(tmp_path: Path) -> None:
    harness.run(Tint(), "random", budget=5, out=tmp_path, keep=KEEP)
    with pytest.raises(FileExistsError, match="other settings: metrics is"):
        harness.run(Tint(), "random", budget=5, out=tmp_path, resume=True)
