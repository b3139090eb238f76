"""How long the parts that every candidate passes through take, by pytest-benchmark.

    python -m pytest benchmarks/speed_suite.py --benchmark-only
    python -m pytest benchmarks/speed_suite.py --benchmark-only --benchmark-autosave
    python -m pytest benchmarks/speed_suite.py --benchmark-only --benchmark-compare

Not part of the tests: seconds need a machine that does nothing else.  `tests/speed` counts the work
instead.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from typing import Any

import numpy as np
import pytest
import torch

import fide_tasks
from fide_plugins import FIDE, encoders, losses
from fide_plugins.proposers.diffusion import DiffusionProposer

pytestmark = pytest.mark.benchmark(warmup=True, warmup_iterations=2)


@pytest.mark.parametrize("size", [112, 224])
@pytest.mark.parametrize("preset", ["fast", "balanced", "accurate"])
def test_a_generation(benchmark: Any, preset: str, size: int) -> None:
    """All but rendering, of an optimizer whose buffers are full."""
    task = fide_tasks.make("voronoi", size=size, seed=0)
    opt = FIDE(task.dim, task.target, preset=preset, seed=0, device="cpu")
    while opt.evaluations < 150:
        X = opt.ask()
        opt.tell(X, task.render(X))
    images = task.render(opt.ask(opt.popsize))

    def generation() -> None:
        X = opt.ask()
        opt.tell(X, np.resize(images, (len(X), *images.shape[1:])))

    benchmark(generation)


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
    rng = np.random.default_rng(0)
    x, images = rng.random((200, 40)), torch.rand(200, tokens, 768)
    proposer = DiffusionProposer(
        40, epochs=1, parameter_tokens=parameter_tokens, precision=precision
    )
    benchmark(proposer.update, x, images, None, np.full(40, 1 / 6))
