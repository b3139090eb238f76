"""Baselines that learn from features of images: Kalman inversion, diffusion models in two uses."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from fide_lab.baselines.base import ImageBased
from fide_lab.baselines.libraries import Search, Sequential, anneal, descent
from fide_plugins.denoiser.training import Denoise, Network, standard_normal
from fide_plugins.errors import OptionError
from fide_plugins.proposers.diffusion import DiffusionProposer
from fide_plugins.runtime.threads import timed
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.options import positive, positive_fraction
from fide_plugins.validation.points import whole_number

BOX_STD = 12**-0.5  # of the uniform law on [0, 1]
LARGEST, SMALLEST = 20.0, 0.02  # noise at the two ends of sampling, in units of BOX_STD
SMALLEST_STD = 1e-3  # of a channel of tokens that is normalized


class PosteriorSampler:
    """Samples of x given an image, for x uniform in the unit cube.

    The diffusion model of `proposers.diffusion`, trained on uniform samples and started from pure
    noise.  Its first step, where the noise is so large that z carries no information, is the
    regression E[x | image], which averages the modes.

    dim: d, the number of parameters.
    steps: of Euler's method for a sample; noise levels fall geometrically.
    options: of the `DiffusionProposer` (epochs, learning_rate, batch_size, device, width, ...).

    Raises OptionError if `steps` is below 1, or as the `DiffusionProposer`.
    """

    def __init__(self, dim: int, *, steps: int = 18, seed: int = 0, **options: Any) -> None:
        if steps < 1:
            raise OptionError(f"sampling takes at least one step, got {steps=}")
        for_proposer, for_samples = np.random.SeedSequence(seed).spawn(2)
        self.proposer = DiffusionProposer(
            dim,
            seed=int(for_proposer.generate_state(1)[0]),
            objective=WhitenedLoss(),
            precondition=partial(whitened, mean=0.5, std=BOX_STD),
            **options,
        )
        self._mean, self._std = np.full(dim, 0.5), np.full(dim, BOX_STD)
        self._schedule = tuple(np.geomspace(LARGEST, SMALLEST, steps).tolist())
        self._rng = np.random.default_rng(for_samples)
        self._scale: tuple[Tensor, Tensor] | None = None

    def update(
        self,
        x: Float64,
        tokens: Tensor,
        *,
        epochs: int | None = None,
        learning_rate: float | None = None,
    ) -> Tensor:
        """Train on uniform `x` (n, d) and the tokens (n, T, C) of their images.

        epochs, learning_rate: of this training; None: the proposer's.

        Returns the mean loss of each epoch; 1 means that nothing was learned.
        """
        if self._scale is None:  # channels of the first images get mean 0 and variance 1
            spread = tokens.std((0, 1), correction=0).clamp_min(SMALLEST_STD)
            self._scale = tokens.mean((0, 1)), spread
        return self.proposer.update(
            x, self._normalize(tokens), None, self._std, epochs=epochs, learning_rate=learning_rate
        )

    def fit(self, x: Float64, tokens: Tensor, epochs: int) -> None:
        """Train on uniform `x` (n, d) and tokens (n, T, C), the last quarter with small steps."""
        last, rate = epochs // 4, self.proposer.learning_rate
        self.update(x, tokens, epochs=epochs - last)
        if last:
            self.update(x, tokens, epochs=last, learning_rate=rate / 5)

    def sample(self, n: int, target_tokens: Tensor) -> Float64:
        """Draw n parameter vectors for an image's tokens (T, C); (n, d), within the unit cube."""
        return self._solve(n, target_tokens, self._schedule)

    def regress(self, target_tokens: Tensor, n: int = 256) -> Float64:
        """Estimate E[x | image], (d,): one step from pure noise, averaged over n draws of it."""
        one_step: Float64 = self._solve(n, target_tokens, (LARGEST,)).mean(axis=0)
        return one_step

    def _solve(self, n: int, target_tokens: Tensor, schedule: tuple[float, ...]) -> Float64:
        noise = self._rng.standard_normal((n, self.proposer.dim))
        z = self._mean + schedule[0] * self._std * noise
        tokens = self._normalize(target_tokens)
        x = self.proposer.propose(z, tokens, self._mean, self._std, schedule=schedule)
        return np.clip(x, 0, 1)

    def _normalize(self, tokens: Tensor) -> Tensor:
        if self._scale is None:
            return tokens
        mean, spread = self._scale
        return (tokens - mean) / spread


class WhitenedLoss:
    """Objective for `whitened` and data with standard deviation `std`.

    Karras et al. 2022, Table 1: ln t ~ N(log_mean, log_std^2).  With the weight
    (1 + t^2) / (t std)^2, a network with output zero has loss 1 at every noise level.
    """

    def __init__(self, log_mean: float = 0.0, log_std: float = 1.5) -> None:
        self.log_mean, self.log_std = log_mean, log_std

    def __call__(
        self, denoise: Denoise, x: Tensor, std: Tensor, generator: torch.Generator
    ) -> Tensor:
        """One draw of time and noise for each example."""
        normal = standard_normal((len(x), 1), x, generator)
        t = (self.log_mean + self.log_std * normal).exp()
        s = t * std  # (B, d)
        eps = standard_normal(x.shape, x, generator)  # ~ N(0, I)
        error = (denoise(x + s * eps, s) - x) / s
        return ((1 + t * t) * error.square()).mean()


def whitened(network: Network, mean: Tensor | float, std: Tensor | float) -> Denoise:
    """Denoiser of data with this `mean` and `std`, [d] or one number for all.

    With u = (z - mean) / std and r = s / std, the estimate is
    u / (1 + r^2) + r / sqrt(1 + r^2) * network(u / sqrt(1 + r^2), r); the network's input and
    its ideal output have variance 1 at every noise level.
    """

    def denoise(z: Tensor, s: Tensor) -> Tensor:
        r = s / std  # [B, d]
        variance = 1 + r * r
        u = (z - mean) / std
        remainder = network(u / variance.sqrt(), r)
        return mean + std * (u / variance + r / variance.sqrt() * remainder)

    return denoise


class Inverse(ImageBased):
    """Inversion without evolution (Sec. 4.1): samples that cover all modes of the posterior.

    popsize: points that are drawn at a time, 100.
    budget: evaluations that are planned.
    share: training fraction, the fraction of the budget that is spent on uniform points.
    epochs: passes over them; the last quarter has a smaller learning rate.
    batch_size, width, blocks: of the training and the network, see `denoiser`.

    The features of all uniform points are kept in memory until the training.  It cannot be resumed.
    The other options are those of `ImageBased`; `sigma0` is not used.  Raises OptionError.
    """

    name: ClassVar[str] = "inverse"
    resumable = False

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        budget: int = 10_000,
        share: float = 0.8,
        epochs: int = 14,
        batch_size: int = 100,
        width: int = 32,
        blocks: int = 2,
        **options: Any,
    ) -> None:
        super().__init__(dim, target, **options)
        self.budget = whole_number("budget", budget, 1)
        self.share = positive_fraction("share", share)
        self.epochs = whole_number("epochs", epochs, 1)
        self.batch_size, self.width, self.blocks = batch_size, width, blocks
        self._rng = np.random.default_rng(self.seed)
        self._posterior = PosteriorSampler(
            self.dim, seed=self.seed, batch_size=batch_size, width=width, blocks=blocks
        )
        self._trained = False
        self._seen: list[tuple[Float64, Float32]] = []  # uniform points, features of their images

    def _sample(self) -> Float64:
        if self._trained:
            return self._posterior.sample(self.popsize, self.target_tokens)
        return self._rng.random((self.popsize, self.dim))  # ~ U(0, 1)

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        if self._trained:
            return
        assert features is not None
        self._seen.extend(zip(X, features, strict=True))
        if len(self._seen) >= max(1, round(self.share * self.budget)):
            with timed(self.times, "train"):
                x, seen = map(np.array, zip(*self._seen, strict=True))
                self._posterior.fit(x, self.tokens_of(seen), self.epochs)
            self._trained, self._seen = True, []
            self._population.forget_pending()

    def _default_popsize(self) -> int:
        return 100


COLLAPSED = 1e-4  # mean standard deviation of an ensemble that is given up
LEAST_NOISE = 1e-12  # variance; an ensemble that has collapsed on the answer is still updated


class EKI(ImageBased):
    """Ensemble Kalman inversion from N(0.5, sigma0^2); options of `ImageBased`.

    With x (k, d) the ensemble, e (k, f) the features of its images, e* those of the target, and
    X, E the deviations from the means over sqrt(k - 1), every generation is (Iglesias, Law and
    Stuart 2013)

        x_i += C_xe (C_ee + Gamma)^-1 (e* + eta_i - e_i),   eta_i ~ N(0, Gamma), Gamma = gamma I.

    Images have no noise of their own, so Gamma regularizes a step; it is annealed by the data
    misfit controller of Iglesias and Yang (2021, arXiv:2006.14061).  Values that leave the box are
    put on its border.  Where an ensemble collapses another one starts around a random point.

    popsize: k, members of the ensemble, at least 2; None: 100, or 2 d if that is more.
    channels: of the tokens of the encoder; by default the mean colors of 14 x 14 patches.
    patience: generations without a better loss after which an ensemble is given up.

    Raises OptionError, and ImageError without a target.
    """

    name: ClassVar[str] = "eki"

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        channels: int | None = 3,
        patience: int = 5,
        **options: Any,
    ) -> None:
        self.patience = whole_number("patience", patience, 1)
        super().__init__(dim, target, channels=channels, **options)
        self._rng = np.random.default_rng(self.seed)
        self.starts = 0  # ensembles begun so far
        self._ended: tuple[float, Float64] | None = None  # loss and mean, the best
        self._start()

    def recommend(self) -> Float64:
        """Mean (dim,) of the ensemble that found the lowest loss, at its end or now."""
        return self._best_ensemble()[1].copy()

    def _best_ensemble(self) -> tuple[float, Float64]:
        """Lowest loss, +inf before there is one, and mean, of this or of an ensemble that ended."""
        present = self._lowest, self._members.mean(axis=0)
        return present if self._ended is None else min(present, self._ended, key=lambda e: e[0])

    def _start(self) -> None:
        center = np.full(self.dim, 0.5) if self.starts == 0 else self._rng.random(self.dim)
        noise = self._rng.standard_normal((self.popsize, self.dim))
        self._members = np.clip(center + self.sigma0 * noise, 0.0, 1.0)
        self._lowest, self._stalled = np.inf, 0
        self.starts += 1

    def _sample(self) -> Float64:
        return self._members

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        assert features is not None
        self._population.forget_pending()  # a member is evaluated once
        e = features.astype(np.float64)
        misfit = self.target_features.astype(np.float64) - features  # (k, f)
        moved = kalman_update(X, e, misfit, annealed(misfit), self._rng)
        self._members = np.clip(moved, 0.0, 1.0)
        self._stalled = 0 if losses.min() < self._lowest else self._stalled + 1
        self._lowest = min(self._lowest, float(losses.min()))
        if self._members.std(axis=0).mean() < COLLAPSED or self._stalled >= self.patience:
            if np.isfinite(self._lowest):
                self._ended = self._best_ensemble()
            self._start()

    def _default_popsize(self) -> int:
        return max(100, 2 * self.dim)

    def _smallest_popsize(self) -> int:
        return 2


def annealed(misfit: Float64) -> float:
    """Variance of the noise for a step from misfits e* - e (k, f): the data misfit controller.

    With Phi = |e* - e_i|^2 / 2 it is the lesser of 2 <Phi> / f and sqrt(2 Var Phi / f).
    """
    phi = np.square(misfit).sum(axis=1) / 2  # (k,)
    f = misfit.shape[1]
    return float(min(2 * phi.mean() / f, np.sqrt(2 * phi.var() / f)))


def kalman_update(
    x: Float64, e: Float64, misfit: Float64, gamma: float, rng: np.random.Generator | None = None
) -> Float64:
    """One step of the ensemble x (k, d) with features e (k, f) and misfits e* - e (k, f).

    gamma: variance of the noise; it is added to the data of each member if there is an `rng`.
    """
    k = len(x)
    X = (x - x.mean(axis=0)) / np.sqrt(k - 1)
    E = (e - e.mean(axis=0)) / np.sqrt(k - 1)
    if rng is not None:
        misfit = misfit + np.sqrt(gamma) * rng.standard_normal(misfit.shape)
    inner = E @ E.T + max(gamma, LEAST_NOISE) * np.eye(k)  # (k, k)
    weights = np.linalg.solve(inner, E @ misfit.T)  # (k, k), a column for each member
    updated: Float64 = x + weights.T @ X
    return updated


LEAST_NOISE_STD = 1e-8


class Visits:
    """State shared by the annealing's thread and the optimizer; it refers to neither."""

    def __init__(self, denoise: Callable[[Float64, Float64], Float64]) -> None:
        self.denoise = denoise
        self.std: Float64 | None = None  # noise model, (d,); None before the first training
        self.count = 0
        self.made: list[Float64] = []  # points that were denoised
        self.descending = False  # whether the local search is at work

    def replace(self, x: Float64) -> None:
        """Denoise every second of the points x (d,) that are visited, in place."""
        self.count += 1
        if self.std is not None and self.count % 2 == 0:
            x[:] = self.denoise(x, self.std)
            self.made.append(x.copy())


class FIDEAnnealing(ImageBased, Sequential):
    """Dual annealing, half of whose points are denoised towards the target (supplement S4).

    Of the points that SciPy's annealing visits every second one is denoised before it is rendered;
    the annealing accepts or rejects the point that was rendered.  Whenever there are k points of
    both kinds the denoiser is trained on their images, and their standard deviations are its noise
    model.  The local search stays SciPy's, and is not collected.  It cannot be resumed.  SciPy
    calls the function with the very array that it keeps when the point is accepted, so the function
    writes the denoised point there.

    samples: k, points before each training; 500 in the paper.
    epochs: of a training.
    encoder, channels: of the images, see `ImageBased`; the paper's simplest by default.
    step: of the finite differences of the local search; None: SciPy's own, 1e-8.

    The other options are those of `ImageBased`; `sigma0` is not used.  Raises OptionError.
    """

    name: ClassVar[str] = "fide-annealing"
    resumable = False

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        samples: int = 500,
        epochs: int = 12,
        encoder: str = "patch",
        step: float | None = None,
        **options: Any,
    ) -> None:
        super().__init__(dim, target, encoder=encoder, **options)
        self.samples = whole_number("samples", samples, 2)
        self.epochs = whole_number("epochs", epochs, 1)
        self.step = None if step is None else positive("step", step)
        self._rng = np.random.default_rng(self.seed)
        self._proposer = DiffusionProposer(self.dim, seed=self.seed, epochs=self.epochs)
        self._visits = Visits(partial(_denoise, self._proposer, self.target_tokens))
        self._seen: list[tuple[Float64, Float32]] = []  # since the last training

    def _search(self) -> Search:
        x0 = np.full(self.dim, 0.5) if self.starts == 0 else self._rng.random(self.dim)
        return partial(_anneal, visits=self._visits, x0=x0, rng=self._rng, step=self.step)

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        assert features is not None
        if not self._visits.descending:
            self._seen.append((X[0], features[0]))
        if len(self._seen) == self.samples:
            points, seen = map(np.array, zip(*self._seen, strict=True))
            self._seen = []
            std = self._visits.std = np.maximum(points.std(axis=0), LEAST_NOISE_STD)
            with timed(self.times, "train"):
                self._proposer.update(points, self.tokens_of(seen), None, std)
        super()._update(X, losses, features)


def _anneal(
    function: Any, visits: Visits, x0: Float64, rng: np.random.Generator, step: float | None
) -> None:
    """SciPy's search, which does not know that some of its points are replaced."""

    def energy(x: Float64) -> Any:
        if not visits.descending:
            visits.replace(x)
        return function(x)

    def descend(fun: Any, start: Float64, **_: Any) -> Any:
        from scipy.optimize import minimize

        visits.descending = True
        try:
            return minimize(fun, start, **descent(len(start), step))
        finally:
            visits.descending = False

    anneal(energy, x0, rng, minimizer_kwargs={"method": descend})


def _denoise(proposer: DiffusionProposer, target: Any, x: Float64, std: Float64) -> Float64:
    proposal: Float64 = np.clip(proposer.propose(x[None], target, x, std)[0], 0.0, 1.0)
    return proposal
