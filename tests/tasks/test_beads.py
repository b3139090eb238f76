"""Beads, and what every Mitsuba task does: fidelity, seeds, bad input."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import fide_tasks
from fide_tasks import Task, mitsuba_task
from fide_tasks.mitsuba_variant import problem_with

pytest.importorskip("mitsuba", reason="Mitsuba is not installed: pip install mitsuba")

RADIUS = 0.25
Array = NDArray[np.float64]
needs_llvm = pytest.mark.skipif(
    problem_with("llvm") is not None, reason=f"LLVM does not run here: {problem_with('llvm')}"
)


def make(size: Any = 32, seed: int = 0, *, spp: int = 4, **options: Any) -> Task:
    return fide_tasks.make("beads", size, seed, **{"spp": spp, "reference_spp": 256, **options})


@pytest.fixture(scope="module")
def task() -> Task:
    """For tests that neither count frames nor depend on how many there were."""
    return make()


def random_x(n: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).random((n, 18))


def loss(image: NDArray[np.float32], target: NDArray[np.float32]) -> float:
    return float(np.square(image.astype(np.float64) - target).mean())


# -- the scene -------------------------------------------------------------------------------------


def test_beads_reach_the_walls_and_go_no_further(task: Task) -> None:
    assert task.dim == 18
    lows, highs = (
        np.array([list(bead.values()) for bead in task.decode(np.full(18, end)).values()])
        for end in (0.0, 1.0)
    )
    np.testing.assert_allclose(lows, -1 + RADIUS)
    np.testing.assert_allclose(highs[:, [0, 2]], 1 - RADIUS)
    assert np.all((highs[:, 1] + RADIUS < 0.99) & (highs[:, 1] + RADIUS > 0.95)), "below the lamp"
    assert list(task.decode(np.zeros(18))["bead 6"]) == [f"{a} [half sides]" for a in "xyz"]


def test_beads_of_targets_keep_apart_and_in_sight() -> None:
    for seed in range(20):
        x = make(8, seed).x_star
        assert x is not None
        c = np.array([list(bead.values()) for bead in make(8, seed).decode(x).values()])
        i, j = np.triu_indices(6, 1)
        assert np.linalg.norm(c[i] - c[j], axis=1).min() > 2 * RADIUS
        depth = 3.9 - c[:, 2:]
        screen, r = c[:, :2] / depth, RADIUS / depth[:, 0]
        apart = np.linalg.norm(screen[i] - screen[j], axis=1)
        assert (apart > np.maximum(r[i], r[j])).all(), "no center hides behind another bead"


@pytest.mark.thorough
def test_the_loss_of_references_is_lowest_at_x_star() -> None:
    task = make(24, reference_spp=1024)
    x, target = task.x_star, task.target
    assert x is not None
    best = loss(task.reference(x), target)
    assert 0 < best < 0.003, "target and reference have noise of their own"
    rng = np.random.default_rng(3)
    far = rng.random((4, 18))
    near = np.tile(x, (6, 1)).reshape(6, 6, 3)
    for row in range(6):
        step = rng.normal(size=3)
        near[row, row] += 0.3 * step / np.linalg.norm(step)
    losses = [loss(task.reference(other), target) for other in [*far, *near.reshape(6, 18)]]
    assert min(losses[:4]) > 2 * best
    assert min(losses[4:]) > 1.1 * best


# -- targets, seeds and batches --------------------------------------------------------------------


def test_the_target_depends_on_the_seed_and_on_no_knob_of_the_frames() -> None:
    target = make(24).target
    np.testing.assert_array_equal(make(24, spp=1).target, target)
    np.testing.assert_array_equal(make(24, threads=1).target, target)
    assert loss(make(24, seed=1).target, target) > 0.003
    task = make(24)
    task.render(random_x(2))
    np.testing.assert_array_equal(task.target, target)
    np.testing.assert_array_equal(make(64).x_star, task.x_star)


@pytest.mark.parametrize("size", [24, (37, 70)])
def test_scalar_gives_the_same_image_on_any_number_of_threads(size: Any) -> None:
    one, eight = (make(size, spp=1, variant="scalar", threads=n) for n in (1, 8))
    x = random_x(1)
    np.testing.assert_array_equal(one.render(x, seed=5), eight.render(x, seed=5))


@needs_llvm
def test_tasks_of_two_variants_work_side_by_side() -> None:
    tasks: list[Any] = [make(variant="scalar"), make(variant="llvm")]
    assert [t.variant for t in tasks] == ["scalar_rgb", "llvm_ad_rgb"]
    first = [t.render(random_x(1), seed=1) for t in tasks]
    for t, image in zip(tasks, first, strict=True):
        np.testing.assert_array_equal(t.render(random_x(1), seed=1), image)
    one, two = (t.reference(random_x(1)[0]) for t in tasks)
    other = make(spp=256).render(random_x(1), seed=1)[0]
    assert 0.6 < loss(one, two) / loss(other, two) < 1.7, "they differ by their noise"


# -- what is imported, and what is refused ---------------------------------------------------------


def test_mitsuba_is_imported_only_when_a_frame_is_rendered() -> None:
    code = (
        "import fide_tasks\n"
        "fide_tasks.names(), fide_tasks.options('beads')\n"
        "task = fide_tasks.make('beads', size=8, spp=1, variant='scalar')\n"
        "heavy = ('mitsuba', 'drjit', 'torch', 'fide_plugins')\n"
        "before = [m for m in heavy if m in sys.modules]\n"
        "task.render([[0.5] * 18])\n"
        "print(before, [m for m in heavy if m in sys.modules])"
    )
    script = f"import sys; sys.path[:0] = {[p for p in sys.path if p]}\n{code}"
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert run.stdout.strip() == "[] ['mitsuba', 'drjit']", run.stderr


@pytest.mark.parametrize(
    ("options", "rule"),
    [
        ({"spp": 0}, "spp must be a whole number >= 1, not 0"),
        ({"max_depth": 0}, "max_depth must be a whole number >= 1, not 0; -1 is any length"),
        ({"reference_spp": 0}, "reference_spp must be"),
        ({"variant": "opencl"}, "variant must be one of 'auto', 'cuda', 'llvm', 'scalar'"),
        ({"threads": 0}, "threads must be a whole number >= 1"),
        ({"beads": 7}, "beads has no option 'beads'; it has .*max_depth"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        fide_tasks.make("beads", **options)


def test_what_is_not_finite_is_black() -> None:
    radiance = np.array([[[np.nan, np.inf, 2.0], [0.0, 0.5, -1.0]]], np.float32)
    out = np.empty_like(radiance)
    mitsuba_task.to_srgb(radiance, out)
    expected = np.array([[[0, 0, 1], [0, 0.7353569, 0]]], np.float32)
    np.testing.assert_allclose(out, expected, atol=1e-6)
