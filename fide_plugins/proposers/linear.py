"""The closed-form proposer: the best linear denoiser, conditioned on a source and on the target.

Notation
--------
=======  ======  ================================================================================
symbol   shape   meaning
=======  ======  ================================================================================
u        (n, d)  parameters of the buffer, in units of std = sqrt(diag Sigma)
e        (n, f)  features of their images, flattened
w        (n,)    weights, falling with the rank of the loss; they sum to 1
z, m             a sample of the search distribution and its mean
u_c e_c          deviations from the weighted means, times sqrt(w)
G        (n, n)  e e^T, all scalar products of features
K        (f, d)  ridge regression of parameters on features
=======  ======  ================================================================================

For (u, e) jointly Gaussian, the best prediction of the parameters of an image e* from a noisy u is
linear, and when the noise is so loud that u says nothing it is E[u | e*] = mean + (e* - mean) K.
The published denoiser starts from a sample of the search distribution; this one starts from an
evaluated candidate, the *source* i, whose parameters and image are both known, and corrects it by
what is wrong with its own image:

    x_new = x_i + a * std * (e* - e_i) K + r * (z - m),   a ~ U(step), r ~ U(0, noise).

That is the linear denoiser trained on all ordered pairs of the buffer (source i, image e_j, answer
x_j), in closed form: the differences u_j - u_i and e_j - e_i have twice the covariances of u and e,
and the same regression.  Only part of the way is asked for, a random part, because the target lies
outside of what the buffer has seen; and a part of the deviation of the sample z is kept (partial
denoising), so that proposals do not fall on one point.

The weights say how local the fit is: a fit that counts all candidates alike is true on average over
the distribution, one that counts only the best is true near the target, and greedy.
`docs/ablation.md` has the measurements.

Everything is computed from G, in n dimensions: an image costs n scalar products once, a generation
one n x n eigendecomposition, whatever the number of features.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor

from fide_plugins.points import Float64

__all__ = ["LinearProposer"]

_TINY = 1e-300
_SMALLEST_STD = 1e-12  # of a parameter; below it is rounding
_SMALLEST_ENERGY = 1e-30


@dataclass(frozen=True, slots=True)
class _Fit:
    """Regression in the space of the buffer: e -> (products of e with e_c) @ coefficients."""

    weights: Float64  # [n]
    coefficients: Float64  # [n, d]


class LinearProposer:
    """Ridge regression from features to parameters, weighted by rank.

    Parameters
    ----------
    dim : d, the number of parameters.
    capacity : n, evaluated candidates that are remembered, the latest.
    elite : weights fall as exp(-rank / (elite * n)).
    ridge : penalty, in units of the trace of e_c e_c^T over min(n, 64).
    sources : the best so many candidates are corrected, one drawn for each proposal.
    step : (low, high), how much of the way is asked for.
    noise : largest share of a sample's deviation that is kept.
    minimum : candidates that must be known before anything is proposed.
    """

    def __init__(
        self,
        dim: int,
        *,
        capacity: int,
        elite: float = 0.5,
        ridge: float = 0.02,
        sources: int = 5,
        step: tuple[float, float] = (0.3, 1.2),
        noise: float = 0.5,
        minimum: int = 2,
    ) -> None:
        self.dim, self.capacity, self.minimum = dim, capacity, minimum
        self.elite, self.ridge = elite, ridge
        self.sources, self.step, self.noise = sources, step, noise
        self.forget()

    def forget(self) -> None:
        """Begin with an empty buffer: the ranks of another search say nothing about this one."""
        self._x: Float64 = np.empty((0, self.dim))
        self._tokens = 1
        self._losses: Float64 = np.empty(0)
        self._features: Float64 = np.empty((0, 0))
        self._gram: Float64 = np.empty((0, 0))
        self._origin: Float64 = np.empty(0)

    @property
    def ready(self) -> bool:
        """Whether there is enough to propose from."""
        return len(self._x) >= self.minimum

    def update(self, x: Float64, tokens: Tensor, losses: Float64, std: Float64) -> None:
        """Remember candidates x (n, d), the tokens (n, T, C) of their images, losses (n,)."""
        self._tokens = tokens.shape[1]
        features = tokens.detach().cpu().numpy().reshape(len(x), -1).astype(np.float64)
        if not len(self._x):  # products of deviations from some image lose no digits
            self._origin = features.mean(axis=0)
            self._features = np.empty((0, features.shape[1]))
        new = features - self._origin
        keep = max(0, self.capacity - len(x))
        old = slice(max(0, len(self._x) - keep), None)
        new = new[-self.capacity :]
        kept = self._features[old]
        cross = new @ kept.T
        self._gram = np.block([[self._gram[old, old], cross.T], [cross, new @ new.T]])
        self._features = np.concatenate([kept, new])
        self._x = np.concatenate([self._x[old], x[-self.capacity :]])
        self._losses = np.concatenate([self._losses[old], losses[-self.capacity :]])

    def propose(
        self,
        z: Float64,
        target: Tensor,
        mean: Float64,
        std: Float64,
        rng: np.random.Generator,
    ) -> Float64:
        """Correct some of the best candidates of the buffer towards the target's tokens (T, C).

        z: (m, d), samples of the search distribution, whose mean and sqrt(diag Sigma) are mean and
        std, (d,) each.  Returns (m, d); values may leave the unit cube.
        """
        ranks = _ranks(self._losses)
        fit = self._fit(ranks, std)
        best = np.argsort(ranks)[: self.sources]
        sources = best[rng.integers(len(best), size=len(z))]
        wanted = target.detach().cpu().numpy().reshape(-1).astype(np.float64) - self._origin
        products = self._features @ wanted - self._gram[sources]  # (e* - e_i) . e_j
        products = (products - (products @ fit.weights)[:, None]) * np.sqrt(fit.weights)
        a = rng.uniform(*self.step, size=(len(z), 1))
        r = rng.uniform(0.0, self.noise, size=(len(z), 1))
        correction = a * std * (products @ fit.coefficients)
        proposals: Float64 = self._x[sources] + correction + r * (z - mean)
        return proposals

    def _fit(self, ranks: npt.NDArray[np.intp], std: Float64) -> _Fit:
        """Solve the regression; stable when the buffer has collapsed to a point."""
        n = len(ranks)
        w = _rank_weights(ranks, self.elite * n)
        u = self._x / np.maximum(std, _TINY)
        u = u - w @ u
        row = self._gram @ w
        gram = self._gram - row - row[:, None] + w @ row  # products of deviations from the mean
        root = np.sqrt(w)
        eigenvalues, vectors = np.linalg.eigh(gram * root * root[:, None])
        eigenvalues = np.maximum(eigenvalues, 0.0)
        rounding = 1e-14 * (self._origin @ self._origin) + _SMALLEST_ENERGY  # float32 features
        penalty = self.ridge * eigenvalues.sum() / min(n, 64) + rounding
        coefficients = (vectors / (eigenvalues + penalty)) @ (vectors.T @ (u * root[:, None]))
        return _Fit(w, coefficients)

    def influence(self) -> Float64 | None:
        """How much each parameter moves each token, (T, d): energy of a ridge fit e ~ J u.

        None where no image was seen.
        """
        if not len(self._x):
            return None
        u = self._x - self._x.mean(axis=0)
        u = u / np.maximum(u.std(axis=0), _SMALLEST_STD)
        features = self._features - self._features.mean(axis=0)
        normal = u.T @ u + 0.01 * len(u) * np.eye(self.dim)
        jacobian = np.linalg.solve(normal, u.T @ features).T
        energy: Float64 = np.square(jacobian).reshape(self._tokens, -1, self.dim).sum(axis=1)
        return energy

    def state_dict(self) -> dict[str, Any]:
        """The buffer."""
        return {
            "x": self._x,
            "losses": self._losses,
            "features": self._features,
            "gram": self._gram,
            "origin": self._origin,
            "tokens": self._tokens,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put back what `state_dict` gave."""
        self._x, self._losses = state["x"], state["losses"]
        self._features, self._gram = state["features"], state["gram"]
        self._origin, self._tokens = state["origin"], int(state["tokens"])


def _ranks(losses: Float64) -> npt.NDArray[np.intp]:
    return np.argsort(np.argsort(losses, kind="stable"), kind="stable")


def _rank_weights(ranks: npt.NDArray[np.intp], scale: float) -> Float64:
    w = np.exp(-ranks / scale)
    weights: Float64 = w / w.sum()
    return weights
