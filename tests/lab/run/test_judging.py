"""What a run is judged by: the reference of its target, or the loss of its images."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from PIL import Image

from fide_lab import optimizers, run as harness
from fide_lab.baselines.evolution import Random
from fide_lab.run.loop import PIECE
from fide_plugins import losses
from fide_plugins.errors import (
    PointsError,
    RenderError,
)
from fide_plugins.types import Float64

from .tint import TARGET, NoisyTint, Tint, raise_interrupt, same

pytestmark = pytest.mark.figures


def test_noise_is_seeded_by_evaluation_and_the_reference_judges() -> None:
    a, b = (harness.run(NoisyTint(), "cma", budget=90, seed=1) for _ in range(2))
    assert same(a, b)
    assert a.x_best is not None
    expected = float(np.square(TARGET - a.x_best.astype(np.float32)).mean())
    assert a.mse == pytest.approx(expected, rel=1e-5)
    assert a.best_loss != a.mse


def test_the_result_of_a_noisy_task_is_judged_by_its_references(tmp_path: Path) -> None:
    task = NoisyTint()
    result = harness.run(task, "cma", "perceptual", 90, seed=1, out=tmp_path)
    assert task.calls == sum(-(-n // PIECE) for n in [7] * 12 + [6]), "judging is no render"
    assert result.x_best is not None and result.x_recommended is not None
    assert result.reference is not None and result.image is not None
    judge = losses.make("perceptual", TARGET)
    by_hand = [judge(task.reference(x)[None])[0] for x in (result.x_best, result.x_recommended)]
    assert [result.reference_loss, result.recommended_loss] == pytest.approx(by_hand, rel=1e-5)
    np.testing.assert_allclose(result.reference, task.reference(result.x_best), rtol=1e-6)
    np.testing.assert_array_equal(result.x_recommended, _recommended(tmp_path))
    totals = json.loads((tmp_path / "run.json").read_text())["totals"]
    assert totals["reference_loss"] == result.reference_loss != totals["best_loss"]
    assert totals["recommended_loss"] == result.recommended_loss
    assert totals["x_recommended"] == result.x_recommended.tolist()
    with Image.open(tmp_path / "reference.png") as png:
        expected = np.rint(result.reference * 255).astype(np.uint8)
        np.testing.assert_array_equal(np.asarray(png), expected)
    with Image.open(tmp_path / "summary.png") as png:
        assert png.width >= 800


def _recommended(out: Path) -> Any:
    (path,) = out.glob("optimizer-*.ckpt")
    return optimizers.load("cma", path).recommend()


def test_without_a_reference_the_render_of_the_run_is_judged(tmp_path: Path) -> None:
    result = harness.run(Tint(), "cma", budget=30, out=tmp_path)
    assert result.reference_loss == result.best_loss
    assert result.x_recommended is None and np.isnan(result.recommended_loss)
    assert json.loads((tmp_path / "run.json").read_text())["totals"]["recommended_loss"] is None
    assert not (tmp_path / "reference.png").exists()


@pytest.mark.parametrize("event", [raise_interrupt, OSError("no lamp")])
def test_a_run_that_stops_while_it_is_judged_can_be_resumed(event: Any, tmp_path: Path) -> None:
    class Stopped(NoisyTint):
        def reference(self, x: Float64) -> Any:
            if isinstance(event, Exception):
                raise event
            event()
            raise AssertionError("the signal was to stop this")

    settings: dict[str, Any] = {"optimizer": "cma", "budget": 40, "seed": 1}
    whole = harness.run(NoisyTint(), **settings)
    with pytest.raises((harness.Interrupted, RenderError)) as caught:
        harness.run(Stopped(), **settings, out=tmp_path)
    if isinstance(event, Exception):
        assert caught.match("noisytint|tint failed to judge the result: .*no lamp")
    wall = json.loads((tmp_path / "run.json").read_text())["totals"]["wall_s"]
    task = NoisyTint()
    resumed = harness.run(task, **settings, out=tmp_path, resume=True)
    assert task.calls == 0
    assert same(whole, resumed)
    assert resumed.wall_s == pytest.approx(wall, abs=5)


def test_a_renderer_that_fails_at_the_target_is_named() -> None:
    class Dark:
        name, dim, render = "dark", 3, Tint.render

        @property
        def target(self) -> Any:
            raise RuntimeError("no lamp")

    with pytest.raises(RenderError, match="dark failed to render its target: no lamp"):
        harness.prepare(cast(Any, Dark()), "cma")


@pytest.mark.parametrize(
    ("point", "said"),
    [([0.5, 0.5, np.nan], "must lie in"), ([0.5] * 4, "the shape"), (2.0 * np.ones(3), "= 2.0")],
)
def test_an_optimizer_that_recommends_no_point_is_named(point: Any, said: str) -> None:
    class Lost(Random):
        name = "lost"

        def recommend(self) -> Any:
            return np.asarray(point)

    class Raises(Random):
        def recommend(self) -> Any:
            raise ZeroDivisionError("nothing was told")

    with pytest.raises(PointsError, match=f"lost recommended an impossible point: .*{said}"):
        harness.run(Tint(), Lost, budget=5)
    with pytest.raises(ZeroDivisionError, match="nothing was told"):  # not the renderer's fault
        harness.run(Tint(), Raises, budget=5)
