"""Each image of a user's renderer is told at once, so that nothing that was rendered is lost."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab import run as harness
from fide_lab.run.task import RendererTask
from fide_plugins import Float, Space
from fide_plugins.errors import RenderError

from .tint import raise_interrupt, same

SPACE = Space(x=Float(-1, 1), y=Float(-1, 1), radius=Float(0.1, 1))
V, U = np.mgrid[-1:1:12j, -1:1:16j]
AT = 46  # render at which something happens, after the first generation of 40 and amid the second


class Disk:
    """A disk; does something at one render, the target being the first."""

    def __init__(self, at: int = 0, then: Callable[[], Any] = raise_interrupt) -> None:
        self.calls, self.at, self.then = 0, at, then

    def __call__(self, p: dict[str, float]) -> Any:
        self.calls += 1
        if self.calls == self.at:
            self.then()
        far = np.hypot(U - p["x"], V - p["y"])
        return np.clip(0.5 + 4 * (p["radius"] - far), 0, 1)


def fails() -> None:
    raise RuntimeError("out of glass")


def task(*at: Any) -> RendererTask:
    return RendererTask("disk", Disk(*at), SPACE, seed=1)


@pytest.mark.parametrize("optimizer", ["cma", "fide"])
@pytest.mark.parametrize(
    ("then", "error"), [(raise_interrupt, harness.Interrupted), (fails, RenderError)]
)
def test_no_finished_render_is_lost_and_the_result_stays(
    optimizer: str, then: Callable[[], Any], error: type[BaseException], tmp_path: Path
) -> None:
    settings: dict[str, Any] = {"budget": 130, "seed": 1, "options": {"popsize": 40}}
    with pytest.raises(error):
        harness.run(task(AT, then), optimizer, **settings, out=tmp_path)
    totals = json.loads((tmp_path / "run.json").read_text())["totals"]
    assert totals["evaluations"] == AT - 2  # without the target, and the one that was stopped
    again = harness.run(task(), optimizer, **settings, out=tmp_path, resume=True)
    assert same(again, harness.run(task(), optimizer, **settings))


def test_pieces_change_no_result(monkeypatch: pytest.MonkeyPatch) -> None:
    alone = harness.run(task(), "random", budget=70, seed=2, options={"popsize": 50})
    monkeypatch.setattr(RendererTask, "piece", None)
    together = harness.run(task(), "random", budget=70, seed=2, options={"popsize": 50})
    np.testing.assert_allclose(alone.losses, together.losses, rtol=1e-9)
    assert alone.best_evaluation == together.best_evaluation
