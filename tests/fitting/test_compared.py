"""Pictures and losses of a fit to a target that the renderer did not draw: as they are compared."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fide_lab import figures
from fide_lab.figures import Panel
from fide_plugins import fit, load_run

_V, _U = np.mgrid[0:24, 0:24] / 23
PHOTO = np.stack([0.2 + 0.5 * _U, 0.3 + 0.3 * _V, 0.6 - 0.3 * _U], axis=-1)


def covered(x: Any) -> Any:
    return (abs(_U - 0.2 - 0.6 * x[0]) < 0.2) & (abs(_V - 0.2 - 0.6 * x[1]) < 0.2)


PHOTO[covered([0.3, 0.6])] = (1.0, 0.9, 0.1)


def pair(x: Any) -> Any:
    """A yellow square, and blue where the renderer says that it draws nothing."""
    a = covered(x).astype(float)
    return np.where(a[..., None] > 0, [1.0, 0.9, 0.1], [0.0, 0.0, 1.0]), a


def rgba(x: Any) -> Any:
    image, a = pair(x)
    return np.concatenate([image, a[..., None]], axis=-1)


@pytest.mark.figures
@pytest.mark.parametrize("render", [pair, rgba])
@pytest.mark.parametrize("options", [{"background": "free"}, {"photo": True}])
def test_what_a_render_does_not_cover_is_the_target_in_all_pictures(
    render: Any, options: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Panel] = []
    draw = figures.draw_image

    def note(axes: Any, panel: Panel) -> None:
        drawn.append(panel)
        draw(axes, panel)

    monkeypatch.setattr(figures, "draw_image", note)
    result = fit(
        render, PHOTO, 2, budget=60, workers=0, seed=0, out=tmp_path / "run", until="budget",
        **options,
    )  # fmt: skip
    assert result.best is not None
    outside = ~(covered(result.best.x) | covered([0.3, 0.6]))
    stored = np.asarray(Image.open(tmp_path / "run" / "best.png")) / 255
    again = load_run(tmp_path / "run")
    pictures = {panel.name: panel.image for panel in drawn}
    best = [stored, pictures["best"], result.compared, again.compared]
    for one in (result, again):
        drawn.clear()
        one.plot()
        best += [panel.image for panel in drawn if panel.name == "best"]
    for image in best:
        np.testing.assert_allclose(image[outside], PHOTO[outside], atol=0.01)
        assert image[covered(result.best.x)][:, 2].max() < 0.5
    assert pictures["first render"][..., 2].max() < 0.9  # no blue
    assert pictures["4x difference"][outside].max() < 0.05


def test_the_light_is_that_of_the_target_and_all_losses_are_of_one_comparison() -> None:
    target = 0.6 * PHOTO + 0.2
    result = fit(
        lambda x: np.where(covered(x)[..., None], [1.0, 0.9, 0.1], PHOTO), target, 2,
        budget=200, workers=0, seed=0, photometric="auto", until="budget",
    )  # fmt: skip
    assert result.best is not None and result.best.image is not None
    assert result.optimizer.state.comparisons == 1
    assert abs(result.compared - target).mean() < 0.2 * abs(result.best.image - target).mean()
    known = np.isfinite(result.losses)
    assert known[result.best.evaluation]
    assert 0 < np.count_nonzero(~known) < 200
    assert result.curve[-1, 1] == result.best.loss == result.losses[known].min()
    assert np.isfinite(result.losses[result.improved_at]).all()


def test_without_such_options_the_picture_is_the_image() -> None:
    result = fit(lambda x: pair(x)[0], PHOTO, 2, budget=20, workers=0, seed=0)
    assert result.compared is None
