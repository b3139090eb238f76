"""Ask and tell at the extremes: whatever comes back, what goes out is a candidate."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from fide_plugins.errors import FideError
from fide_plugins.fide import FIDE
from fide_plugins.types import Float32, Float64

FOLDER = Path(tempfile.mkdtemp())  # for files that a case writes over
CASES = int(os.environ.get("FIDE_CASES", "1"))  # times as many as in CI

LOSSES = (
    "of images",
    "constant",
    "equal but one",
    "from -1e300 to 1e300",
    "the largest numbers",
    "denormal",
    "some NaN",
    "some infinite",
    "all NaN",
    "all minus infinity",
    "sphere",
    "corner",
)
IMAGES = (
    "none",
    "blurred",
    "hidden parameters",
    "black",
    "white",
    "one pixel",
    "the target",
    "noise",
    "from 0 to 1e-30",
    "beyond 1",
)


def losses_of(what: str, X: Float64, rng: np.random.Generator) -> Float64 | None:
    """Losses (n,) to be told of candidates X (n, d); None: those of the images."""
    n = len(X)
    some = rng.random(n) < rng.random()
    sphere: Float64 = np.square(X - 0.3).sum(axis=1)
    values: dict[str, Float64] = {
        "constant": np.zeros(n),
        "equal but one": -(np.arange(n) == rng.integers(n)).astype(float),
        "from -1e300 to 1e300": rng.choice([-1.0, 1.0], n) * 10.0 ** rng.uniform(-300, 300, n),
        "the largest numbers": rng.choice([-1.0, 1.0, 0.97], n) * sys.float_info.max,
        "denormal": np.multiply(5e-324, rng.integers(0, 3, n)),
        "some NaN": np.where(some, np.nan, sphere),
        "some infinite": np.where(some, rng.choice([np.inf, -np.inf], n), sphere),
        "all NaN": np.full(n, np.nan),
        "all minus infinity": np.full(n, -np.inf),
        "sphere": sphere,
        "corner": X.sum(axis=1),
    }
    return values.get(what)


def images_of(what: str, X: Float64, target: Float32, rng: np.random.Generator) -> Float32 | None:
    """Images (n, H, W, 3) to be told of candidates X (n, d)."""
    shape = (len(X), *target.shape)
    images: Float32 = np.zeros(shape, np.float32)
    columns = X[:, :1] if what == "hidden parameters" else X
    weights = np.random.default_rng(0).standard_normal((columns.shape[1], target.size))
    blurred = (1 / (1 + np.exp((columns - 0.5) @ weights))).reshape(shape)
    match what:
        case "none":
            return None
        case "blurred" | "hidden parameters":
            images[:] = blurred
        case "white":
            images[:] = 1.0
        case "one pixel":
            images[:, 0, 0, 0] = rng.random(len(X))
        case "the target":
            images[:] = target
        case "noise":
            images[:] = rng.random(shape)
        case "from 0 to 1e-30":
            images[:] = 1e-30 * blurred
        case "beyond 1":
            images[:] = 2.5 * blurred - 0.5
    return images


def drive(
    opt: FIDE, losses: str, images: str, budget: int, seed: int, tell: Any = None
) -> list[Float64]:
    """Ask and tell, generation by generation; returns what was asked."""
    rng = np.random.default_rng(seed)
    asked = []
    while opt.evaluations < budget:
        X = opt.ask()
        asked.append(X)
        shown = images_of(images, X, opt.target, rng)
        values = losses_of(losses, X, rng)
        if shown is None and values is None:
            values = X[:, 0]
        (tell or opt.tell)(X, shown, values)
    return asked


def check(opt: FIDE) -> None:
    search = opt.state.search.distribution
    assert np.isfinite(search.mean).all() and np.isfinite(search.C).all()
    assert np.linalg.eigvalsh(search.C)[0] > 0
    assert np.isfinite(search.std).all() and (search.std > 0).all()
    assert ((opt.recommend() >= 0) & (opt.recommend() <= 1)).all()
    proposer: Any = opt.state.proposer
    if hasattr(proposer, "_buffers"):
        assert all(np.isfinite(buffer.gram).all() for buffer in proposer._buffers)
    assert 0 <= opt.state.gate.fraction <= 1


sizes = st.sampled_from([(1, 1), (1, 5), (3, 2), (8, 8), (2, 40)])


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:.*clipped to:RuntimeWarning")
@pytest.mark.filterwarnings("ignore:all images of:RuntimeWarning")
@settings(max_examples=60 * CASES, deadline=None)
@given(
    dim=st.integers(1, 9),
    popsize=st.one_of(st.none(), st.integers(4, 40)),
    sigma0=st.floats(-16, 0).map(lambda power: 10.0**power),
    preset=st.sampled_from(["fast", "balanced", "accurate"]),
    restarts=st.sampled_from(["moves", "anew", "none"]),
    size=sizes,
    target=st.sampled_from(["black", "white", "noise", "answer"]),
    losses=st.sampled_from(LOSSES),
    images=st.sampled_from(IMAGES),
    seed=st.integers(0, 2**64),
)
def test_candidates_lie_in_the_box_and_the_best_never_gets_worse(
    dim: int, popsize: int | None, sigma0: float, preset: str, restarts: str,
    size: tuple[int, int], target: str, losses: str, images: str, seed: int,
) -> None:  # fmt: skip
    rng = np.random.default_rng(seed)
    blank = np.zeros((*size, 3), np.float32)
    pictures: dict[str, Any] = {
        "black": blank,
        "white": blank + 1,
        "noise": rng.random(blank.shape),
    }
    if target == "answer":
        pictures["answer"] = images_of("blurred", rng.random((1, dim)), blank, rng)
        pictures["answer"] = pictures["answer"][0]
    opt, twin = (
        FIDE(
            dim, pictures[target], popsize=popsize, sigma0=sigma0, preset=preset, seed=seed,
            restarts=restarts, patience=2 if restarts != "none" else None,
        )
        for _ in range(2)
    )  # fmt: skip
    best, told = np.inf, 0

    def tell(X: Float64, shown: Float32 | None, values: Float64 | None) -> None:
        nonlocal best, told
        assert X.dtype == np.float64 and ((X >= 0) & (X <= 1)).all()
        np.testing.assert_array_equal(twin.ask(), X)
        for each in (opt, twin):
            each.tell(X, shown, values)
        told += len(X)
        assert opt.evaluations == told
        now = np.inf if opt.best is None else opt.best.loss
        assert now <= best
        best = now
        check(opt)

    drive(opt, losses, images, 8 * opt.popsize, seed % 2**32, tell)
    opt.save(FOLDER / "saved")
    X = opt.ask()
    for each in (twin, FIDE.load(FOLDER / "saved")):
        np.testing.assert_array_equal(each.ask(), X)


ANYTHING: list[Any] = [
    None, True, 0, 1.5, "x", b"x", {}, [], [[]], [None], object(), np.nan, 1j, {1}, slice(3),
    np.zeros(0), np.zeros(2), np.zeros(3), np.zeros((2, 2)), np.zeros((3, 2)), np.ones((3, 2)),
    np.full((3, 2), np.nan), np.full((3, 2), 2.0), np.full((3, 2), -0.0), np.zeros((3, 2), "S1"),
    np.zeros((3, 2), object), np.zeros((3, 2), np.int8), np.zeros((3, 2, 1)), [0.5, 0.5, 0.5],
    [np.inf, np.nan, -np.inf], np.zeros((3, 4, 4, 3)), np.zeros((3, 4, 4)), np.ones((3, 4, 4, 4)),
    np.zeros((3, 4, 4, 3), np.uint8), np.zeros((3, 4, 4, 3), np.int64), np.zeros((3, 4, 5, 3)),
    np.full((3, 4, 4, 3), np.inf), np.full((3, 4, 4, 3), 1e300), [np.zeros((4, 4, 3))] * 3,
    [np.zeros((4, 4, 3)), "x", None], [np.zeros((4, 4))] * 2, np.zeros((3, 16, 16)),
    np.full((3, 16, 16), 1e300), np.zeros((3, 16, 16), complex), 10**400, [10**400] * 3,
]  # fmt: skip


@pytest.mark.filterwarnings("ignore")  # of NumPy, about what is no array
@settings(max_examples=180 * CASES, deadline=None)
@given(*[st.sampled_from(range(len(ANYTHING)))] * 3)
def test_whatever_is_told_counts_or_is_refused_and_changes_nothing(
    points: int, images: int, losses: int
) -> None:
    opt = FIDE(2, np.zeros((4, 4, 3)), popsize=4, seed=0)
    asked = opt.ask()
    X = asked[:3] if points % 3 == 0 else ANYTHING[points]
    told = ANYTHING[images], ANYTHING[losses]
    before = len(opt.state.population.pending)
    try:
        opt.tell(X, *told)
    except FideError as error:
        assert isinstance(error, ValueError)
        assert (opt.evaluations, len(opt.state.population.pending), opt.best) == (0, before, None)
    else:
        assert opt.evaluations == len(X)
    opt.tell(asked, np.zeros((4, 4, 4, 3)))
    assert opt.best is not None and np.isfinite(opt.best.loss)
    check(opt)
