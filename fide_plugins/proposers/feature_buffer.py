"""Features of the images that a proposer remembers, and ridge regression by their products.

Notation: e (n, T, C), features; o (T, C), an origin, since products of deviations lose few digits;
G (n, n) = (e - o) (e - o)^T, over tokens and channels.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from fide_plugins.runtime.schema import Plain, Schema, Sides, Stateful, array, check, whole
from fide_plugins.types import Float64, Indices, Mask

MOST = 600  # candidates: each generation costs a regression on as many
NEGLIGIBLE = 1e-6
_FEW = 8  # leaving out fewer than one in so many is not worth the copy


def for_jacobian(dim: int) -> int:
    """Candidates to which a Jacobian of d parameters is fitted: 4 d + 20, at most `MOST`."""
    return min(4 * dim + 20, MOST)


@dataclass(eq=False)
class FeatureBuffer(Stateful):
    """One channel subset: features of the images that are remembered, and their products.

    A token that is the same in every image says nothing, whatever the target shows there.  So as
    many tokens are left out, those that vary least, as hold a share `NEGLIGIBLE` of the variance
    together.  Such a token was at its origin in every image, up to that share; so it comes back
    with the first image in which it has moved, with zeros for the older ones, and nothing was lost.

    channels: so many leading ones; None: all.
    select: leave out tokens that do not vary.
    features: (n, f), deviations from the origin, of the tokens in use.
    gram: (n, n).  origin: (T, C).  used: (T,), the tokens that are not left out.
    unchecked: images since it was last seen which tokens vary.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {
        "features": array("n", "f", low=-1e60, high=1e60),
        "gram": array("n", "n", low=-1e125, high=1e125),
        "origin": array("t", "c", low=-1e60, high=1e60),
        "used": array("t", kind="b"),
        "unchecked": whole(),
    }

    channels: int | None
    select: bool = True
    features: Float64 = field(default_factory=lambda: np.empty((0, 0)))
    gram: Float64 = field(default_factory=lambda: np.empty((0, 0)))
    origin: Float64 = field(default_factory=lambda: np.empty((0, 0)))
    used: Mask = field(default_factory=lambda: np.empty(0, bool))
    unchecked: int = 0
    _toward: tuple[Tensor, Float64, Float64] | None = None

    @property
    def rounding(self) -> float:
        """Energy of features below which there are only their last digits."""
        return float(1e-14 * np.square(self.origin[self.used]).sum())

    def add(self, tokens: Tensor, capacity: int) -> None:
        """Append images, tokens (m, T, C), and forget all but the last `capacity`."""
        self._toward = None
        seen = self._seen(tokens)
        if not len(self.features):
            self.origin = seen.mean(axis=0)
            self.used = np.full(len(self.origin), not self.select)
            self.features = np.empty((0, int(self.used.sum()) * seen.shape[2]))
        deviations = (seen - self.origin)[-capacity:]
        surplus = max(0, len(self.features) + len(deviations) - capacity)
        self.gram, self.features = self.gram[surplus:, surplus:], self.features[surplus:]
        if self.select and not self.used.all():
            moved = ~_negligible(deviations) | self.used
            if (moved != self.used).any():
                self._use(moved)
        new = self._flat(deviations)
        cross = new @ self.features.T
        n = len(self.gram)
        gram = np.empty((n + len(new), n + len(new)))
        gram[:n, :n], gram[:n, n:] = self.gram, cross.T
        gram[n:, :n], gram[n:, n:] = cross, new @ new.T
        self.gram = gram
        self.features = np.concatenate([self.features, new])
        self.unchecked += len(new)
        if self.select and self.unchecked >= len(self.features):  # once for every set of images
            self._leave_out()
            self.unchecked = 0

    def toward(self, target: Tensor) -> tuple[Float64, Float64]:
        """Features e* (f,) of a target, (T, C), in the tokens in use; e* . e_j for all j, (n,)."""
        if self._toward is None or self._toward[0] is not target:
            wanted = self._flat(self._seen(target[None]) - self.origin)[0]
            self._toward = target, wanted, self.features @ wanted
        return self._toward[1:]

    def keep(self, which: Indices) -> None:
        """Forget all images but these (n,), in that order."""
        self._toward = None
        self.gram, self.features = self.gram[np.ix_(which, which)], self.features[which]

    def _seen(self, tokens: Tensor) -> Float64:
        """Tokens (m, T, C) without the channels of other subsets."""
        return tokens.detach()[..., : self.channels].cpu().numpy().astype(np.float64)

    def _flat(self, deviations: Float64) -> Float64:
        """Features (m, f) of deviations (m, T, C): those of the tokens in use."""
        if not self.used.all():
            deviations = np.ascontiguousarray(deviations[:, self.used])
        n, tokens, channels = deviations.shape
        return deviations.reshape(n, tokens * channels)

    def _leave_out(self) -> None:
        """Use those tokens no more that vary in none of the images, if they are not just a few."""
        features = self.features.reshape(len(self.features), -1, self.origin.shape[1])
        means = features.mean(axis=0)
        still = _negligible(features - means)
        if _FEW * still.sum() <= still.size:
            return
        left_out = features[:, still].reshape(len(features), int(still.sum()) * features.shape[2])
        self.gram = self.gram - left_out @ left_out.T
        used = self.used.copy()
        used[self.used] = ~still
        self.origin = self.origin.copy()
        self.origin[self.used & ~used] += means[still]
        self._use(used)

    def _use(self, used: Mask) -> None:
        """Change the tokens in use to these (T,); those that come were at their origin."""
        n, channels = len(self.features), self.origin.shape[1]
        before = self.features.reshape(n, int(self.used.sum()), channels)
        features = np.zeros((n, int(used.sum()), channels))
        features[:, self.used[used]] = before[:, used[self.used]]
        self.features, self.used = features.reshape(n, features.shape[1] * channels), used

    def load_state_dict(self, state: Plain, sides: Sides | None = None) -> None:
        """Put back what `state_dict` gave; ValueError if it is none.

        sides: n, and T, the number of tokens, if that is known.
        """
        found = dict(sides or {})
        n, tokens = found["n"], found.get("T")
        found = {"n": n, "t": tokens} if n and tokens is not None else {"n": n}
        check(state, self.SCHEMA, found, "feature buffer")
        if n and found["f"] != int(state["used"].sum()) * found["c"]:
            raise ValueError(f"feature buffer has {found['f']} features, not those of its tokens")
        super().load_state_dict(state, {"n": n})
        self._toward = None


def _negligible(deviations: Float64) -> Mask:
    """Which tokens (T,) of deviations (n, T, C) hold a share `NEGLIGIBLE` of the energy together.

    Those of least energy.
    """
    energy = np.einsum("ntc,ntc->t", deviations, deviations)
    order = np.argsort(energy, kind="stable")
    small: Mask = np.empty(len(energy), bool)
    small[order] = np.cumsum(energy[order]) <= NEGLIGIBLE * energy.sum()
    return small


# -- ridge regression ----------------------------------------------------------------------------

_TINY = 1e-300
_SMALLEST_GAP = 1e-3  # of a leverage to 1
_SAFE = 1e-4  # smallest penalty for the inverse; then G + p is conditioned well enough


class Ridge(NamedTuple):
    """Coefficients (n, d); residuals (n, d) and leverages (n,)."""

    coefficients: Float64
    residuals: Float64
    leverages: Float64


def ridge(gram: Float64, u: Float64, penalty: float, rounding: float) -> Ridge:
    """Regress u (n, d) on features with the scalar products `gram` (n, n).

    The coefficients are (G + p)^-1 u, the residuals p (G + p)^-1 u, and the leverages the diagonal
    of 1 - p (G + p)^-1 (Allen 1974): by Cholesky, which takes a fifth of the time of eigenvalues,
    unless the penalty is so small that G + p may be singular.

    penalty: p, in units of the trace of `gram` over min(n, 64); rounding: added to it.
    """
    n = len(gram)
    if penalty >= _SAFE:
        p = penalty * float(np.trace(gram)) / min(n, 64) + rounding
        factor, failed = torch.linalg.cholesky_ex(torch.from_numpy(gram + p * np.eye(n)))
        if not failed:
            inverse: Float64 = torch.cholesky_inverse(factor).numpy()
            coefficients = inverse @ u
            return Ridge(coefficients, p * coefficients, 1 - p * np.diag(inverse))
    eigenvalues, vectors = np.linalg.eigh(gram)
    eigenvalues = np.maximum(eigenvalues, 0.0)
    p = penalty * eigenvalues.sum() / min(n, 64) + rounding
    rotated = vectors.T @ u
    shrinkage = eigenvalues / (eigenvalues + p)
    residuals = u - vectors @ (shrinkage[:, None] * rotated)
    return Ridge((vectors / (eigenvalues + p)) @ rotated, residuals, vectors**2 @ shrinkage)


def explained(u: Float64, fit: Ridge, w: Float64) -> Float64:
    """Leave-one-out R^2 (d,) of a regression, at most 1, below 0 where the mean predicts better.

    u: (n, d), deviations from the weighted mean, times the roots of the weights w (n,).
    """
    leverages = fit.leverages.reshape(len(u), -1) + w[:, None]  # of the regression, and of the mean
    residuals = fit.residuals / np.maximum(1 - leverages, _SMALLEST_GAP)
    scale = np.maximum(np.abs(u).max(axis=0), _TINY)  # squares would overflow
    variance = np.square(u / scale).sum(axis=0)
    share: Float64 = 1 - np.square(residuals / scale).sum(axis=0) / np.maximum(variance, _TINY)
    return share
