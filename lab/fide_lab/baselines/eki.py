"""Ensemble Kalman inversion: least squares on the features of the image, by an ensemble.

Notation
--------
======  =======  ===============================================================================
symbol  shape    meaning
======  =======  ===============================================================================
x       (k, d)   the ensemble
e       (k, f)   features of its images; e* those of the target
X, E    (k, .)   deviations from the means, over sqrt(k - 1): C_xe = X^T E, C_ee = E^T E
gamma             variance of the noise of the data, Gamma = gamma I
======  =======  ===============================================================================

Every generation (Iglesias, Law and Stuart 2013)

    x_i += C_xe (C_ee + Gamma)^-1 (e* + eta_i - e_i),   eta_i ~ N(0, Gamma),

computed in the k dimensions of the ensemble: C_xe (C_ee + Gamma)^-1 = X^T (E E^T + gamma I)^-1 E.

The images here have no noise of their own, so Gamma is what regularizes a step, and it is annealed
by the data misfit controller of Iglesias and Yang (2021, https://arxiv.org/abs/2006.14061),
so that it falls as the ensemble comes nearer; see `annealed`.  Their bound of 1 / gamma, at which a
run ends, is left out: images have no level of noise at which to stop.  Values that leave the box
are put on its border.  The ensemble stays in its own span and collapses there: then another one
starts around a random point.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from fide_lab.baselines.image_features import ImageBased
from fide_lab.baselines.stateful import Stateful
from fide_plugins.runtime.schema import GENERATOR, Schema, array, maybe, real, row, whole
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.points import whole_number

__all__ = ["EKI", "annealed", "kalman_update"]

COLLAPSED = 1e-4  # mean standard deviation of an ensemble that is given up
LEAST_NOISE = 1e-12  # variance; an ensemble that has collapsed on the answer is still updated


class EKI(ImageBased, Stateful):
    """Ensemble Kalman inversion from N(0.5, sigma0^2); options of `ImageBased` and `Baseline`.

    popsize: k, members of the ensemble, at least 2; None: 100, or 2 d if that is more.
    channels: of the tokens of the encoder; by default the mean colors of 14 x 14 patches.
    patience: generations without a better loss after which an ensemble is given up.

    Raises OptionError, and ImageError without a target (ValueErrors).
    """

    name: ClassVar[str] = "eki"
    own_schema: ClassVar[dict[str, Schema]] = {
        "members": array("k", "d", low=0.0, high=1.0),
        "lowest": real(high=np.inf),
        "ended": maybe(row(real(), array("d", low=0.0, high=1.0))),
        "stalled": whole(),
        "starts": whole(),
        "rng": GENERATOR,
    }

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
        self._ended: tuple[float, Float64] | None = None  # as `_present`, the best that is over
        self._start(np.full(self.dim, 0.5))

    def recommend(self) -> Float64:
        """Mean (dim,) of the ensemble that found the lowest loss, at its end or now."""
        _, mean = self._best_ensemble()
        return mean.copy()

    def _present(self) -> tuple[float, Float64]:
        """Lowest loss of the present ensemble, +inf before it has one, and its mean (dim,)."""
        return self._lowest, self._members.mean(axis=0)

    def _best_ensemble(self) -> tuple[float, Float64]:
        """As `_present`, of the present ensemble or of one that is over."""
        present = self._present()
        return present if self._ended is None else min(present, self._ended, key=lambda e: e[0])

    def _start(self, center: Float64) -> None:
        noise = self._rng.standard_normal((self.popsize, self.dim))
        self._members = np.clip(center + self.sigma0 * noise, 0.0, 1.0)
        self._lowest, self._stalled = np.inf, 0
        self.starts += 1

    def _sample(self) -> Float64:
        return self._members

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        assert features is not None
        self._population.forget_pending()  # a member is evaluated once
        misfit = self.target_features.astype(np.float64) - features  # (k, f)
        e = features.astype(np.float64)
        updated = kalman_update(X, e, misfit, annealed(misfit), self._rng)
        self._members = np.clip(updated, 0.0, 1.0)
        self._stalled = 0 if losses.min() < self._lowest else self._stalled + 1
        self._lowest = min(self._lowest, float(losses.min()))
        if self._members.std(axis=0).mean() < COLLAPSED or self._stalled >= self.patience:
            if np.isfinite(self._lowest):
                self._ended = self._best_ensemble()
            self._start(self._rng.random(self.dim))

    def _default_popsize(self) -> int:
        return max(100, 2 * self.dim)

    def _smallest_popsize(self) -> int:
        return 2

    def _own_settings(self) -> dict[str, Any]:
        return {**super()._own_settings(), "patience": self.patience}

    def _own_state(self) -> dict[str, Any]:
        return {
            "members": self._members,
            "lowest": self._lowest,
            "ended": None if self._ended is None else list(self._ended),
            "stalled": self._stalled,
            "starts": self.starts,
            "rng": self._rng.bit_generator.state,
        }

    def _load_own_state(self, state: dict[str, Any]) -> None:
        self._members, self._lowest = state["members"], state["lowest"]
        self._ended = None if state["ended"] is None else tuple(state["ended"])
        self._stalled, self.starts = state["stalled"], state["starts"]
        self._rng.bit_generator.state = state["rng"]


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
