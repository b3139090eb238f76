"""Runs of the optimizers for `golden`, and what is kept of a run."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

import fide_tasks
from fide_lab import optimizers
from fide_plugins import FIDE, losses

Float32: TypeAlias = npt.NDArray[np.float32]
Float64: TypeAlias = npt.NDArray[np.float64]
Tell: TypeAlias = Callable[[Any, Float64, Float32, Float64], None]
"""Tells an optimizer the results of candidates (n, d): images (n, H, W, 3) and losses (n,)."""
RESUMED = "resumed "  # before what a loaded copy did
RESUMED_GENERATIONS = 2

# -- what is kept of a run -------------------------------------------------------------------------


def digest(value: Any) -> str:
    """SHA-256 of an array's dtype, shape and bytes, or of a text."""
    if isinstance(value, str):
        return hashlib.sha256(value.encode()).hexdigest()
    array = np.ascontiguousarray(value)
    head = f"{array.dtype.str} {array.shape} ".encode()
    return hashlib.sha256(head + array.tobytes()).hexdigest()


class Trace:
    """Hashes of each generation of a run, in order."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.generations: list[dict[str, str]] = []

    def note(self, **values: Any) -> None:
        """Add one generation; values by what they are."""
        self.generations.append({name: digest(value) for name, value in values.items()})

    def note_optimizer(self, opt: Any, X: Float64, values: Float64, where: str = "") -> None:
        """Add one generation of an optimizer: its candidates (n, d) and their losses (n,)."""
        known = {"candidates": X, "losses": values, "recommend": opt.recommend(), **best_of(opt)}
        self.note(**{where + name: value for name, value in known.items()})

    def reloaded(self, opt: Any, load: Callable[[Path], Any]) -> Any:
        """A copy of the optimizer by way of a checkpoint."""
        path = self.folder / "checkpoint"
        opt.save(path)
        return load(path)


def best_of(opt: Any) -> dict[str, Any]:
    """The best solution's point, and its loss and number."""
    best = opt.best
    if best is None:
        return {"best.x": "none", "best.loss": "none"}
    return {"best.x": best.x, "best.loss": np.array([best.loss, best.evaluation])}


# -- problems and ways to tell ---------------------------------------------------------------------


class Problem(NamedTuple):
    """Dim, target (H, W, 3), renderer and loss, for images (n, H, W, 3)."""

    dim: int
    target: Float32
    render: Callable[[Float64], Float32]
    loss: Callable[[Float32], Float64]


def problem(name: str = "voronoi", loss: str = "mse", size: int = 32, **options: Any) -> Problem:
    """A task of `fide_tasks`; by default a small one."""
    if name == "voronoi":
        options.setdefault("cells", 4)
    task = fide_tasks.make(name, size=size, seed=0, **options)
    return Problem(task.dim, task.target, task.render, losses.make(loss, task.target))


def random_of(X: Float64) -> np.random.Generator:
    """Generator that depends on the candidates only, so that a copy draws the same."""
    return np.random.default_rng(np.ascontiguousarray(X).view(np.uint32).ravel())


def tell_images(opt: Any, X: Float64, images: Float32, values: Float64) -> None:
    opt.tell(X, images)


def tell_both(opt: Any, X: Float64, images: Float32, values: Float64) -> None:
    opt.tell(X, images, values)


def tell_losses(opt: Any, X: Float64, images: Float32, values: Float64) -> None:
    opt.tell(X, None, values)


def tell_float32(opt: Any, X: Float64, images: Float32, values: Float64) -> None:
    opt.tell(X.astype(np.float32), images)


def tell_noise(opt: Any, X: Float64, images: Float32, values: Float64) -> None:
    """Misleading images: noise, with the true losses."""
    opt.tell(X, random_of(X).random(images.shape, np.float32), values)


def tell_others(opt: Any, X: Float64, images: Float32, values: Float64) -> None:
    """Misleading images: those of other candidates, with the true losses."""
    opt.tell(X, images[::-1], values)


def tell_failures(opt: Any, X: Float64, images: Float32, values: Float64) -> None:
    """One loss in four is NaN, one in twelve infinite."""
    u = random_of(X).random(len(X))
    opt.tell(X, images, np.where(u < 1 / 4, np.nan, np.where(u < 1 / 3, np.inf, values)))


def tell_sometimes(opt: Any, X: Float64, images: Float32, values: Float64) -> None:
    """Images of the first half, only losses of the second, and the last one twice."""
    half = len(X) // 2
    if half:
        opt.tell(X[:half], images[:half])
    opt.tell(X[half:], None, values[half:])
    opt.tell(X[-1:], images[-1:])


# -- runs of the optimizers ------------------------------------------------------------------------


def minimize(
    trace: Trace,
    opt: Any,
    p: Problem,
    evaluations: int,
    *,
    load: Callable[[Path], Any] = FIDE.load,
    tell: Tell = tell_images,
    every: int = 8,
) -> None:
    """Ask and tell whole generations, and save in some: one in `every`, and all of another size.

    A generation of another size holds sensitivity samples or restart candidates.
    """
    usual, before = 0, 0
    for generation in count():
        if opt.evaluations >= evaluations:
            break
        X = opt.ask()
        images, usual = p.render(X), usual or len(X)
        values, half = p.loss(images), len(X) // 2
        other = generation > 0 and len({usual, before, len(X)}) > 1
        saves = getattr(opt, "resumable", True)
        if saves and (other or generation % every == every - 1):
            if half:
                tell(opt, X[:half], images[:half], values[:half])
            copy = trace.reloaded(opt, load)
            tell(copy, X[half:], images[half:], values[half:])
            resume(trace, copy, p, tell)
            tell(opt, X[half:], images[half:], values[half:])
        else:
            tell(opt, X, images, values)
        before = len(X)
        trace.note_optimizer(opt, X, values)


def resume(trace: Trace, copy: Any, p: Problem, tell: Tell) -> None:
    """Continue a loaded copy."""
    for _ in range(RESUMED_GENERATIONS):
        X = copy.ask()
        images = p.render(X)
        values = p.loss(images)
        tell(copy, X, images, values)
        trace.note_optimizer(copy, X, values, RESUMED)


def fide(
    trace: Trace,
    p: Callable[[], Problem] = problem,
    evaluations: int = 500,
    seed: int = 0,
    tell: Tell = tell_images,
    **options: Any,
) -> None:
    """One run of FIDE."""
    made = p()
    opt = FIDE(made.dim, made.target, seed=seed, device="cpu", **options)
    minimize(trace, opt, made, evaluations, tell=tell)


def baseline(trace: Trace, name: str, evaluations: int, every: int = 3, **settings: Any) -> None:
    """One run of any optimizer, by its name."""
    p = problem()
    opt = optimizers.make(name, p.dim, p.target, seed=3, **settings)
    load = partial(optimizers.load, name)
    minimize(trace, opt, p, evaluations, load=load, tell=tell_both, every=every)


def disorder(trace: Trace, steps: int = 70, seed: int = 0, **options: Any) -> None:
    """Everything that workers do: a warm start, any number asked, results late, twice or never."""
    p, rng = problem(), np.random.default_rng(seed)
    opt = FIDE(p.dim, p.target, seed=seed, device="cpu", **options)
    guess = rng.random((3, p.dim))
    opt.tell(guess, p.render(guess))
    pending = np.empty((0, p.dim))
    for step in range(steps):
        X = opt.ask(None if step % 3 == 0 else int(rng.integers(1, 25)))
        pending = rng.permutation(np.concatenate([pending, X]))
        told, lost, pending = np.split(pending, [int(0.7 * len(pending)), int(0.8 * len(pending))])
        opt.withdraw(lost)
        for piece in np.array_split(told, 3):
            if len(piece):
                opt.tell(piece, p.render(piece))
        if step % 5 == 4:  # never asked, withdrawn, told before
            extra = np.concatenate([np.clip(X[:1] + 0.01, 0, 1), lost[:1], told[:1]])
            opt.tell(extra, p.render(extra))
        if step % 10 == 9:
            opt.ask(3)  # never told, never withdrawn
            opt = trace.reloaded(opt, FIDE.load)
        trace.note_optimizer(opt, X, p.loss(p.render(X)))


def pieces(trace: Trace, steps: int = 150, **options: Any) -> None:
    """Three at a time, told backwards: saved wherever that cuts a generation."""
    p = problem()
    opt = FIDE(p.dim, p.target, seed=2, device="cpu", **options)
    for step in range(steps):
        X = opt.ask(3)
        if step % 7 == 6:
            opt = trace.reloaded(opt, FIDE.load)
        values = p.loss(p.render(X))
        opt.tell(X[::-1], p.render(X[::-1]))
        trace.note_optimizer(opt, X, values)


def sphere_alone(trace: Trace) -> None:
    """Losses only, until CMA-ES has converged and begins again."""

    def render(X: Float64) -> Float32:
        return np.zeros((len(X), 8, 8, 3), np.float32)

    opt = FIDE(3, render(np.zeros((1, 3)))[0], seed=1, popsize=6, proposer="none", device="cpu")
    for step in count():
        if opt.evaluations >= 2500:
            break
        X = opt.ask()
        values: Float64 = np.square(X - [0.2, 0.7, 0.4]).sum(axis=1)
        opt.tell(X, None, values)
        if step % 50 == 49:
            opt = trace.reloaded(opt, FIDE.load)
        trace.note_optimizer(opt, X, values)
