"""What single precision changes: the next candidates, from the same state, each generation.

Losses, the search and the linear and the forward model compute in double precision; images,
features and the network in single. Each part is rounded to single precision here, alone, in a copy
of an optimizer that has been told the same, and the copy's next generation is compared with the
optimizer's, in standard deviations of the search.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch

import fide_tasks
from fide_plugins.fide import FIDE
from fide_plugins.types import Float32, Float64

GENERATIONS = 14
TASKS = [
    "voronoi",
    "spline",
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("robot", "beads", "san_miguel")),
]
ULP = 2.0**-24  # of single precision, relative

Told = tuple[Float64, torch.Tensor, Float64]  # points, tokens, losses


def single(values: npt.ArrayLike) -> Float64:
    """Values as single precision has them."""
    return np.asarray(values, np.float32).astype(np.float64)


def exactly(opt: FIDE, told: Told) -> None:
    X, tokens, losses = told
    opt.tell(X, losses=losses, features=tokens)


def with_rounded_losses(opt: FIDE, told: Told) -> None:
    X, tokens, losses = told
    opt.tell(X, losses=single(losses), features=tokens)


def with_rounded_features(opt: FIDE, told: Told) -> None:
    """They are in single precision already: another rounding of each, up or down."""
    X, tokens, losses = told
    signs = np.random.default_rng(0).choice([-1.0, 1.0], tokens.shape)
    opt.tell(X, losses=losses, features=tokens.double().numpy() * (1 + ULP * signs))


def with_rounded_proposer(opt: FIDE, told: Told) -> None:
    exactly(opt, told)
    proposer: Any = opt.state.proposer
    for buffer in getattr(proposer, "_buffers", None) or [proposer._buffer]:
        buffer.features, buffer.gram = single(buffer.features), single(buffer.gram)


def with_rounded_search(opt: FIDE, told: Told) -> None:
    exactly(opt, told)
    search = opt.state.search.distribution
    search.mean, search.C, search.sigma = (
        single(search.mean), single(search.C), float(np.float32(search.sigma)),
    )  # fmt: skip
    search._decompose()


def with_bfloat16_features(opt: FIDE, told: Told) -> None:
    """As of a network on a GPU: eight bits."""
    X, tokens, losses = told
    opt.tell(X, losses=losses, features=tokens.bfloat16().float())


# rounded: (median, largest) difference of candidates over the generations of a task
BOUNDS: dict[Callable[[FIDE, Told], None], tuple[float, float]] = {
    with_rounded_losses: (0.0, 0.0),  # ranks are the same
    with_rounded_features: (1e-4, 0.2),
    with_rounded_proposer: (1e-3, 0.2),
    with_rounded_search: (1e-3, np.inf),  # eigenvectors of equal eigenvalues may turn
    with_bfloat16_features: (0.2, np.inf),
}


def generations(task: Any, proposer: str) -> Iterator[tuple[FIDE, Told]]:
    """Optimizer before each generation is told, and what it will be told."""
    opt = FIDE(task.dim, task.target, seed=0, proposer=proposer)
    for _ in range(GENERATIONS):
        X = opt.ask()
        first = opt.evaluations
        images: Float32 = task.render(X, seed=list(range(first, first + len(X))))
        told = X, opt.encoder(images), opt.evaluator.loss(images)
        yield opt, told
        opt.tell(X, losses=told[2], features=told[1])


def next_candidates(
    opt: FIDE, tell: Callable[[FIDE, Told], None], told: Told
) -> tuple[Any, Float64]:
    """What a copy that is told decides (stage, number of proposals), and its candidates."""
    other = copy.deepcopy(opt)
    tell(other, told)
    X = other.ask()
    proposed = sum(candidate.proposed for candidate in other.state.population._pending.values())
    return (other.state.stage, proposed), X


def make(name: str) -> Any:
    options = {"spp": 4} if name in ("beads", "san_miguel") else {}
    return fide_tasks.make(name, size=32, seed=0, **options)


@pytest.mark.thorough
@pytest.mark.parametrize("proposer", ["linear", "forward"])
@pytest.mark.parametrize("name", TASKS)
def test_a_step_in_single_precision(name: str, proposer: str) -> None:
    """Decisions are the same, candidates nearly."""
    found: dict[Any, list[float]] = {rounded: [] for rounded in BOUNDS}
    for opt, told in generations(make(name), proposer):
        decided, X = next_candidates(opt, exactly, told)
        for rounded, values in found.items():
            also_decided, other = next_candidates(opt, rounded, told)
            assert also_decided == decided or rounded is with_bfloat16_features
            alike = X.shape == other.shape
            values.append(
                float((np.abs(X - other) / opt.state.search.std).max()) if alike else np.inf
            )
    for rounded, (median, most) in BOUNDS.items():
        assert np.median(found[rounded]) <= median and max(found[rounded]) <= most, rounded.__name__
