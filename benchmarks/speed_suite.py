"""Times of the code that every candidate passes through, by pytest-benchmark.

    python -m pytest benchmarks/speed_suite.py --benchmark-only
    python -m pytest benchmarks/speed_suite.py --benchmark-only --benchmark-autosave
    python -m pytest benchmarks/speed_suite.py --benchmark-only --benchmark-compare

This suite is not part of the tests: its times, although CPU times, need an otherwise idle machine.
`tests/speed` counts the work instead.  The limits in lab/reports/time.md are checked.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from profile_overlap import CONFIGURATIONS, Late

import fide_tasks
from fide_plugins import FIDE, encoders, losses
from fide_plugins.proposers.diffusion import DiffusionProposer
from fide_plugins.runtime.devices import has_bfloat16

pytestmark = pytest.mark.benchmark(warmup=True, warmup_iterations=2, timer=time.process_time)


MOST = {"fast": 0.7, "balanced": 2.0, "accurate": 2.0}
"""Milliseconds a candidate that are promised at 112 x 112."""
LATER = 1.05
"""Wall time relative to CMA-ES that is promised with a renderer of 10 ms."""


@pytest.mark.parametrize("size", [112, 224])
@pytest.mark.parametrize("preset", ["fast", "balanced", "accurate"])
def test_five_generations(benchmark: Any, preset: str, size: int, tmp_path: Path) -> None:
    """All but rendering: the same five of a run, every time, whose buffers are full before."""
    task = fide_tasks.make("voronoi", size=size, seed=0)
    opt = FIDE(task.dim, task.target, preset=preset, seed=0, device="cpu")
    while opt.evaluations < 150:
        X = opt.ask()
        opt.tell(X, task.render(X))
    opt.save(tmp_path / "before")
    images = []
    for _ in range(5):
        X = opt.ask()
        images.append(task.render(X))
        opt.tell(X, images[-1])

    def before() -> tuple[tuple[FIDE], dict[str, Any]]:
        return (FIDE.load(tmp_path / "before", device="cpu"),), {}

    def five(opt: FIDE) -> None:
        for seen in images:
            opt.tell(opt.ask(), seen)

    benchmark.pedantic(five, setup=before, rounds=40, warmup_rounds=3)
    ms = 1e3 * benchmark.stats.stats.median / sum(map(len, images))
    benchmark.extra_info["ms a candidate"] = ms
    assert size > 112 or ms < MOST[preset]


def test_who_waits_for_a_renderer_waits_little_longer_than_with_cma_es() -> None:
    walls = {
        configuration: np.median(
            [Late(*CONFIGURATIONS[configuration], 0.01).times(500)[0] for _ in range(3)]
        )
        for configuration in ("CMA-ES", "FIDE balanced")
    }
    assert walls["FIDE balanced"] < LATER * walls["CMA-ES"]


@pytest.mark.parametrize("size", [112, 224, 1024])
@pytest.mark.parametrize("what", ["dense", "patch", "mse", "perceptual"])
def test_an_image(benchmark: Any, what: str, size: int) -> None:
    """Encoded, or compared with the target."""
    images = np.random.default_rng(0).random((1, size, size, 3), dtype=np.float32)
    if what in ("dense", "patch"):
        benchmark(encoders.make(what, device="cpu").compute, images)
    else:
        benchmark(losses.make(what, 1 - images[0]).compute, images)


@pytest.mark.parametrize("tokens", [49, 196])
@pytest.mark.parametrize("parameter_tokens", [None, 8])
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_an_epoch(
    benchmark: Any, tokens: int, parameter_tokens: int | None, precision: str
) -> None:
    """Of the network, on 200 candidates of 40 parameters."""
    if precision == "bfloat16" and not has_bfloat16(torch.device("cpu")):
        pytest.skip("this CPU has no products in bfloat16")
    rng = np.random.default_rng(0)
    x, images = rng.random((200, 40)), torch.rand(200, tokens, 768)
    proposer = DiffusionProposer(
        40, epochs=1, parameter_tokens=parameter_tokens, precision=precision
    )
    benchmark(proposer.update, x, images, None, np.full(40, 1 / 6))
