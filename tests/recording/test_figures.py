"""The loss curve of a run's picture."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from fide_plugins import Choice, Float, Space
from fide_plugins.recording.figures import _time_bar, _title, draw_curve
from fide_plugins.recording.record import PARTS, Record, Verdict, result_of


def drawn(*losses: float) -> Any:
    """Axes with the curve of these losses."""
    axes = Figure().add_subplot()
    draw_curve(axes, np.array(losses), "mse")
    return axes


@pytest.mark.parametrize(
    ("losses", "scale", "best"),
    [
        ((1e-1, np.inf, 1e-6), "log", (1e-1, 1e-1, 1e-6)),
        ((1e-1, 1e-6, 0.0), "log", (1e-1, 1e-6, 1e-7)),  # 0 below the least that is shown
        ((0.5, -0.5, 1.0), "linear", (0.5, -0.5, -0.5)),
        ((0.0, 0.0, 0.0), "linear", (0.0, 0.0, 0.0)),
    ],
)
def test_the_axis_is_logarithmic_wherever_it_can_be(
    losses: tuple[float, ...], scale: str, best: tuple[float, ...]
) -> None:
    axes = drawn(*losses)
    assert axes.get_yscale() == scale
    np.testing.assert_allclose(axes.lines[0].get_ydata(), best)
    assert len(axes.collections[0].get_offsets()) == int(np.isfinite(losses).sum())


@pytest.mark.parametrize(
    ("space", "words"),
    [
        (None, "5 parameters"),
        (Space(x=Float(0, 1), floor=Choice("a", "b", "c", "d")), "2 parameters"),
        (Space(floor=Choice("a", "b", "c", "d", "e")), "1 parameter"),
    ],
)
def test_the_title_counts_parameters_not_coordinates(space: Space | None, words: str) -> None:
    known = dict.fromkeys(("task", "optimizer", "loss", "seed", "task_seed"), 0)
    settings = {**known, "dim": 5, "space": None if space is None else space.to_dict()}
    result = result_of(settings, Record(), Verdict(), budget=1)
    figure = Figure()
    _title(figure, replace(result, task="t", optimizer="fide"))
    assert figure.texts[1].get_text() == f"{words}   0 renders   seed 0"
    assert result.dim == 5


def test_without_a_finite_loss_it_is_empty() -> None:
    axes = drawn(np.inf, np.nan)
    assert not axes.lines and not axes.collections


@pytest.mark.parametrize(
    ("wall", "words"), [(2.0, ["search 25%", "other 25%"]), (1.5, ["search 33%"])]
)
def test_what_is_none_of_the_parts_has_a_name(wall: float, words: list[str]) -> None:
    axes = Figure().add_subplot()
    times = dict.fromkeys(PARTS, 0.0) | {"render": 1.0, "search": 0.5}
    _time_bar(axes, SimpleNamespace(times=times, wall_s=wall))  # type: ignore[arg-type]
    texts = [text.get_text() for text in axes.texts]
    assert [text for text in texts if text.startswith(("search", "other"))] == words
