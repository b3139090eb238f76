"""Values of renders that are not those of the target: what a fit says, and when."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins import Float, Space, fit, load_run
from fide_plugins.errors import ValueRangeError

V, U = np.mgrid[0:24, 0:24] / 23
SPACE = Space(x=Float(0, 1), y=Float(0, 1), r=Float(0.02, 0.2))
AT = {"x": 0.7, "y": 0.35, "r": 0.15}


def draw(p: dict[str, float]) -> Any:
    return np.exp(-2 * ((U - p["x"]) ** 2 + (V - p["y"]) ** 2) / p["r"] ** 2)


def colored(p: dict[str, float]) -> Any:
    return draw(p)[..., None] * np.array([0.9, 0.5, 0.1]) + np.array([0.0, 0.1, 0.05])


def test_renders_of_0_to_255_end_the_fit_at_once(tmp_path: Path) -> None:
    rendered: list[int] = []

    def bright(p: dict[str, float]) -> Any:
        rendered.append(1)
        return 250 * draw(p)

    with pytest.raises(ValueRangeError, match="another scale") as raised:
        fit(bright, draw(AT), SPACE, budget=300, workers=0, seed=0, out=tmp_path / "a")
    assert len(rendered) == 1 and raised.value.result.evaluations == 0  # type: ignore[attr-defined]


def test_what_was_found_before_is_not_lost(tmp_path: Path) -> None:
    """Renders get bright late: the fit ends, and goes on where the renderer is mended."""
    rendered: list[int] = []

    def late(p: dict[str, float]) -> Any:
        rendered.append(1)
        return draw(p) * (1 if len(rendered) <= 30 else 250)

    options: dict[str, Any] = {"workers": 0, "seed": 0, "out": tmp_path / "a", "until": "budget"}
    with pytest.raises(ValueRangeError) as raised:
        fit(late, draw(AT), SPACE, budget=50, **options)
    result = raised.value.result  # type: ignore[attr-defined]
    assert result.evaluations == 30 and result.best is not None and result.failures == 0
    rendered.clear()
    again = fit(late, draw(AT), SPACE, budget=50, resume=True, **options)
    assert again.evaluations == 50 and again.failures == 0


@pytest.mark.parametrize("kind", [np.uint16, np.int32])
def test_a_type_without_a_scale_ends_the_fit_at_once(kind: Any) -> None:
    with pytest.raises(ValueRangeError, match="uint8 in"):
        fit(lambda p: (60000 * draw(p)).astype(kind), draw(AT), SPACE, budget=9, workers=0)
    counts = (60000 * draw(AT)).astype(kind)
    result = fit(
        lambda p: (60000 * draw(p)).astype(kind), counts, SPACE, 9, workers=0,
        value_range=(0, 65535),
    )  # fmt: skip
    assert result.evaluations == 9 and result.failures == 0


def test_an_overshoot_is_counted_in_the_result() -> None:
    with pytest.warns(RuntimeWarning, match="clipped"):
        result = fit(lambda p: 1.1 * draw(p), draw(AT), SPACE, budget=20, workers=0, seed=0)
    assert 0 < result.clipped <= 20 and f"{result.clipped} images clipped" in repr(result)


def test_swapped_channels_are_named() -> None:
    options: dict[str, Any] = {"budget": 120, "workers": 0, "seed": 1}
    with pytest.warns(RuntimeWarning, match=r"red and blue swapped.*image\[\.\.\., ::-1\]"):
        fit(lambda p: colored(p)[..., ::-1], colored(AT), SPACE, **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit(colored, colored(AT), SPACE, **options)
        fit(draw, draw(AT), SPACE, budget=5, workers=0, seed=1)  # far from solved


@pytest.mark.parametrize("values", [(0, 255), "auto"])
def test_floats_for_bytes_are_named_with_a_value_range(values: Any) -> None:
    target = (255 * draw(AT)).astype(np.uint8)
    options: dict[str, Any] = {"budget": 100, "workers": 0, "seed": 1, "value_range": values}
    with pytest.warns(RuntimeWarning, match=r"times as bright.*return 255 \* image"):
        fit(draw, target, SPACE, **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit(lambda p: 255 * draw(p), target, SPACE, **options)


def test_the_target_of_a_run_is_read_exactly(tmp_path: Path) -> None:
    def both(p: dict[str, float]) -> list[Any]:
        return [60_000 * draw(p), 60_000 * draw(p)[:8, :6]]

    options: dict[str, Any] = {"workers": 0, "out": tmp_path / "a", "value_range": (0, 65535)}
    result = fit(both, both(AT), SPACE, 4, **options)
    for one, other in zip(load_run(tmp_path / "a").target, result.target, strict=True):
        np.testing.assert_array_equal(one, other)
