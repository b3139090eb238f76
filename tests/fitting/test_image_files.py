"""A renderer may write every image to one file or array: each candidate is told with its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from fide_plugins import FIDE, Float, Space, fit
from fide_plugins.fitting.callbacks import Event
from fide_plugins.fitting.failures import RenderFailedWarning

GRAY = Space(gray=Float(0, 1))
TARGET = np.full((8, 8), 0.4)
HALF = 0.5 / 255
"""Largest error of a value in a file."""


def one_array(tensor: bool) -> Callable[[Any], Any]:
    """Function that draws every image of a thread into the same array, or tensor."""
    own = threading.local()

    def render(params: dict[str, float]) -> Any:
        if not hasattr(own, "image"):
            own.image = np.zeros((8, 8), np.float32)
        own.image[...] = params["gray"]
        return torch.from_numpy(own.image) if tensor else own.image

    return render


def one_file(folder: Path, views: int = 1, opened: bool = False) -> Callable[[Any], Any]:
    """Function that writes its image to the same file in each render of a worker.

    views: number of images, of which it returns a list if there are several.
    opened: it returns what Pillow has opened, not the path.
    """
    place = str(folder)

    def render(params: dict[str, float]) -> Any:
        import os
        import threading

        import numpy as np
        from PIL import Image

        gray = np.full((8, 8), round(255 * params["gray"]), np.uint8)
        files = []
        for view in range(views):
            files.append(f"{place}/{os.getpid()}-{threading.get_ident()}-{view}.png")
            Image.fromarray(gray).save(files[-1])
        returned = [Image.open(file) for file in files] if opened else files
        return returned[0] if views == 1 else returned

    return render


@pytest.fixture
def slow_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    """Telling takes longer than the next render, as with large images and small scenes."""
    tell = FIDE.tell

    def late(self: FIDE, X: Any, images: Any, **options: Any) -> Any:
        time.sleep(0.03)
        losses = tell(self, X, images, **options)
        time.sleep(0.03)
        return losses

    monkeypatch.setattr(FIDE, "tell", late)


@pytest.mark.thorough
@pytest.mark.usefixtures("slow_tell")
@pytest.mark.parametrize("executor", ["threads", "processes"])
@pytest.mark.parametrize(("views", "opened"), [(1, False), (2, False), (1, True)])
def test_each_candidate_is_told_with_its_own_image(
    executor: str, views: int, opened: bool, tmp_path: Path
) -> None:
    check(one_file(tmp_path, views, opened), executor, views)


@pytest.mark.thorough
@pytest.mark.usefixtures("slow_tell")
@pytest.mark.parametrize("tensor", [False, True])
def test_threads_may_draw_into_one_array_each(tensor: bool) -> None:
    check(one_array(tensor), "threads", 1)


def check(render: Callable[[Any], Any], executor: str, views: int) -> None:
    """Fit, and look at every loss and at every image that callbacks get."""
    wrong = []

    def look(event: Event) -> None:
        assert event.params is not None
        gray = event.params["gray"]
        images = [event.image] if views == 1 else event.image
        shown = max(abs(float(image.mean()) - gray) for image in images)
        told = abs(np.sqrt(event.loss) - abs(gray - 0.4))
        if max(shown, told) > 1.01 * HALF:
            wrong.append(event.evaluation)

    target = TARGET if views == 1 else [TARGET] * views
    options: dict[str, Any] = {"loss": "mse", "workers": 2, "seed": 0, "callbacks": look}
    options["until"] = "budget"  # most pictures look the same after rounding
    result = fit(render, target, GRAY, budget=24, executor=executor, **options)
    assert (result.evaluations, result.failures, wrong) == (24, 0, [])


@pytest.mark.parametrize("opened", [False, True])
def test_a_half_written_file_is_a_failed_render(opened: bool, tmp_path: Path) -> None:
    whole = one_file(tmp_path, opened=False)

    def render(params: dict[str, float]) -> Any:
        from PIL import Image

        file = Path(whole(params))
        if params["gray"] > 0.6:
            file.write_bytes(file.read_bytes()[:-20])
        return Image.open(file) if opened else file

    with pytest.warns(RenderFailedWarning, match="truncated"):
        result = fit(render, TARGET, GRAY, budget=40, workers=0, seed=0, sigma0=0.3, until="budget")
    assert result.evaluations == 40 and result.failures > 0
