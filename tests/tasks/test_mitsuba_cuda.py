"""Mitsuba on a GPU: its frames, and its denoiser.

A frame is the sum of its paths, which a GPU adds in another order every time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import fide_tasks
from fide_tasks import Task

pytest.importorskip("mitsuba", reason="Mitsuba is not installed: pip install mitsuba")
ROUNDING = 1e-5


def make(variant: str = "cuda", **options: Any) -> Task:
    return fide_tasks.make("beads", 32, **{"spp": 16, "variant": variant, **options})


@pytest.mark.gpu
@pytest.mark.parametrize("name", ["beads", "san_miguel"])
def test_a_seed_determines_a_frame_up_to_rounding(name: str) -> None:
    task, other = (fide_tasks.make(name, 32, spp=4, variant="cuda") for _ in range(2))
    x = np.random.default_rng(0).random((3, task.dim))
    frames = task.render(x, seed=5)
    for again in (task.render(x, seed=5), other.render(x, seed=5)):
        np.testing.assert_allclose(again, frames, atol=ROUNDING)
    assert (np.abs(task.render(x, seed=6) - frames) > ROUNDING).mean() > 0.2


@pytest.mark.gpu
def test_with_many_paths_it_is_the_image_of_a_processor() -> None:
    x = np.random.default_rng(0).random(18)
    there, here = (make(variant, reference_spp=512).reference(x) for variant in ("cuda", "scalar"))
    noise = make(spp=512).render(np.tile(x, (16, 1)), seed=0).std(axis=0, ddof=1)
    off = np.abs(there - here)
    assert (off > 6 * np.hypot(noise, noise) + 0.01).mean() < 0.02
    assert abs(float((there - here).mean())) < 3e-3
