"""CMA-ES that takes candidates it did not draw (*injected* candidates).

m (d,), sigma, C (d, d), p_sigma and p_c (d,) and equation numbers are those of Hansen 2016, "The
CMA Evolution Strategy: A Tutorial" (arXiv:1604.00772); C = B diag(D^2) B^T.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import ClassVar

import numpy as np

from fide_plugins.runtime.schema import Plain, Schema, Sides, Stateful, anything, array, real, whole
from fide_plugins.types import Float64, Mask

_MEMORY = 0.3  # weight of the newest comparison


class TwoPoint(Stateful):
    """Whether the last steps of the mean went far enough.

    dim: d, the number of parameters.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {
        "shift": array("d", low=-1e60, high=1e60),
        "trend": real(-1.0, 1.0),
    }

    def __init__(self, dim: int) -> None:
        self.damping = 0.7 + 2 * np.log(dim)
        self.shift = np.zeros(dim)  # last step of the mean, in units of sigma
        self.trend = 0.0  # in [-1, 1]; above 0 steps are too short

    def pair(self, y: Float64, lengths: Callable[[Float64], Float64]) -> Float64:
        """Two steps (2, d) along and against the last one, as long as the first sample y (2, d).

        lengths: Mahalanobis lengths (n,) of steps (n, d).  Before the first step: y itself.
        """
        if not self.shift.any():
            return y
        shift_length, length = lengths(np.stack([self.shift, y[0]]))
        ahead = self.shift * (length / shift_length)
        return np.stack([ahead, -ahead])

    def factor(self, shift: Float64, losses: Float64, pair: tuple[int, int] | None) -> float:
        """What to multiply the step size by, after a generation that moved the mean by `shift`.

        losses: (k,) of the generation.  pair: where in it the two steps along and against are; None
            if one of them was lost.
        """
        had_pair, self.shift = bool(self.shift.any()), shift
        if pair is None or not had_pair:
            return 1.0
        ahead, against = (float(np.mean(losses < losses[i])) for i in pair)  # ranks in [0, 1)
        lead = (against - ahead) * len(losses) / (len(losses) - 1)  # in [-1, 1]
        self.trend += _MEMORY * float(np.sign(lead) * np.sqrt(abs(lead)) - self.trend)
        return float(np.exp(self.trend / self.damping))


_TINY = 1e-300
_SMALLEST_SIGMA, _LARGEST_SIGMA = 1e-200, 1e32
_SMALLEST_STD = 1e-14  # of the widest parameter; below it samples in a box of side 1 are all equal
_FARTHEST = 2**10  # from 1 that the scale of C may drift
_LARGEST_CONDITION = 1e14  # of C; beyond it eigenvectors are noise
_WIDE_ENOUGH = 1 / 3  # of the box, in which such samples are nearly uniform
_OUTLIER = 10.0  # times the longest step that a sample may have; none ever is as long


def default_popsize(dim: int) -> int:
    """Population size 4 + 3 ln d (Hansen 2016, eq. 48)."""
    return 4 + int(3 * np.log(dim))


def are_many(dim: int, popsize: int) -> bool:
    """Whether a generation is small for so many parameters: d > 4 k.

    No problem of up to 64 parameters is, at the default population.
    """
    return dim > 4 * popsize


class CMAES(Stateful):
    """N(m, sigma^2 C), refined by ranked candidates.

    Libraries assume, or silently repair, candidates that are not theirs.  Two rules make injected
    ones safe: their steps are cut to the length a sample may have (Hansen 2011, arXiv:1110.4181,
    eq. 3), and the mean standard deviation does not exceed a limit.  With nothing injected and no
    limit the numbers are those of `cmaes`, up to dimensions of 4 k.  Beyond, C is decomposed only
    as often as it changes (section B.2), and the step size follows `TwoPoint`.

    mean: (d,), where the search begins.
    std: its standard deviation there; one number, or one for each parameter (d,).
    popsize: k >= 2, candidates an update.
    widest: hold the mean standard deviation at or below so many times that of the beginning.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {
        "mean": array("d", low=-1e60, high=1e60),
        "sigma": real(1e-30, 1e32),
        "C": array("d", "d", low=-1e12, high=1e12),
        "p_sigma": array("d", low=-1e60, high=1e60),
        "p_c": array("d", low=-1e60, high=1e60),
        "generation": whole(),
        "largest_std": real(0.0, np.inf),
        "B": array("d", "d", low=-1.01, high=1.01),
        "D": array("d", low=1e-30, high=1e6),
        "two_point": anything,
    }
    _B: Float64
    _D: Float64

    def __init__(
        self, mean: Float64, std: float | Float64, popsize: int, *, widest: float = 1.0
    ) -> None:
        self.dim = d = len(mean)
        k = popsize
        scales = np.broadcast_to(np.asarray(std, np.float64), (d,))
        self.mean = np.array(mean, np.float64)
        self.sigma = float(np.sqrt(np.mean(scales**2)))
        self.C = np.diag((scales / self.sigma) ** 2)
        self.p_sigma, self.p_c = np.zeros(d), np.zeros(d)
        self.generation = 0
        self.popsize = k
        self.largest_std = widest * float(scales.mean())
        self._two_point = TwoPoint(d) if are_many(d, k) else None
        self.draws_pair = self._two_point is not None
        """Whether the first two of a sample are a pair that measures the step size."""
        self._set_weights(d, k)
        self._decompose()

    def _set_weights(self, d: int, k: int) -> None:
        """Weights and rates of learning, from dimension and population alone."""
        raw = np.log((k + 1) / 2) - np.log(np.arange(1, k + 1))  # eq. 49
        self._mu = k // 2
        positive, negative = raw[: self._mu], raw[self._mu :]
        mu_eff = positive.sum() ** 2 / (positive**2).sum()
        mu_eff_minus = negative.sum() ** 2 / max((negative**2).sum(), _TINY)
        self._c_1 = 2 / ((d + 1.3) ** 2 + mu_eff)  # eq. 57
        rank_mu = 2 * (mu_eff - 2 + 1 / mu_eff) / ((d + 2) ** 2 + mu_eff)
        self._c_mu = min(1 - self._c_1 - 1e-8, rank_mu)  # eq. 58
        bounds = [1 + 2 * mu_eff_minus / (mu_eff + 2)]  # eq. 51
        if self._c_mu > 0:
            bounds.append(1 + self._c_1 / self._c_mu)  # eq. 50
            bounds.append((1 - self._c_1 - self._c_mu) / (d * self._c_mu))  # eq. 52
        scale = np.where(raw >= 0, 1 / positive.sum(), min(bounds) / max(-negative.sum(), _TINY))
        self._weights = raw * scale  # eq. 53
        self._mu_eff = mu_eff
        self._c_sigma = (mu_eff + 2) / (d + mu_eff + 5)  # eq. 55
        crowd = max(0.0, np.sqrt((mu_eff - 1) / (d + 1)) - 1)
        self._d_sigma = 1 + 2 * crowd + self._c_sigma  # eq. 55
        self._c_c = (4 + mu_eff / d) / (d + 4 + 2 * mu_eff / d)  # eq. 56
        self._chi = np.sqrt(d) * (1 - 1 / (4 * d) + 1 / (21 * d * d))  # E |N(0, I)|
        slow = 1 / (10 * d * (self._c_1 + self._c_mu))  # generations in which C hardly changes
        self._decompose_every = max(1, int(slow)) if are_many(d, k) else 1
        self._longest_step = np.sqrt(d) + 2 * d / (d + 2)  # Hansen 2011, eq. 3

    @property
    def std(self) -> Float64:
        """sqrt(diag Sigma), (d,): the per-parameter noise of the denoiser (supplement S1)."""
        return self.sigma * np.sqrt(np.maximum(np.diag(self.C), 0.0))

    def sample(self, n: int, rng: np.random.Generator) -> Float64:
        """Draw n candidates, (n, d); they may leave the unit cube, see `mixed`.

        Of many parameters the first two are a pair that measures the step size, see `TwoPoint`.
        """
        y = (rng.standard_normal((n, self.dim)) * self._D) @ self._B.T  # ~ N(0, C)
        if self._two_point is not None and n >= 2:
            y[:2] = self._two_point.pair(y[:2], self._lengths)
        z: Float64 = self.mean + self.sigma * y
        return z

    def tell(
        self,
        z: Float64,
        losses: Float64,
        injected: Mask,
        pair: tuple[int, int] | None = (0, 1),
    ) -> None:
        """Learn from one generation.

        z: (k, d), candidates as drawn (not repaired).
        losses: (k,); only their order matters.  Where none is finite nothing changes; but as long
            as none ever was, the next generation is wider.
        injected: (k,), which of them this distribution did not draw.
        pair: where among them the first two of the sample are; None if one of them was lost.
        """
        if not np.isfinite(losses).any():
            if self.generation == 0:
                self._widen()
            return
        order = np.argsort(losses, kind="stable")
        y, lengths = self._steps(z[order], injected[order])
        y_w = self._weights[: self._mu] @ y[: self._mu]  # eq. 41
        self.mean = self.mean + self.sigma * y_w  # eq. 42
        self.generation += 1
        self._adapt(y, y_w, lengths)
        if self._two_point is None:
            path = float(np.linalg.norm(self.p_sigma))
            rate = self._c_sigma / self._d_sigma * (path / self._chi - 1)
            factor = float(np.exp(min(1.0, rate)))  # eq. 44
        else:
            lost = pair is None or bool(injected[list(pair)].any())
            factor = self._two_point.factor(y_w, losses, None if lost else pair)
        self._scale_sigma(factor)
        far = lengths.max() > _OUTLIER * self._longest_step  # C may be singular, but for rounding
        if far or self.generation % self._decompose_every == 0:
            self._decompose()
        std = self.std
        if std.mean() > self.largest_std:
            self._scale_sigma(self.largest_std / std.mean())
        elif std.max() < _SMALLEST_STD:
            self._scale_sigma(_SMALLEST_STD / std.max())

    def _widen(self) -> None:
        """Double the distribution, up to where its samples are nearly uniform in the box."""
        mean = float(self.std.mean())
        self._scale_sigma(max(1.0, min(2.0, _WIDE_ENOUGH / mean)))

    def preview(self, z: Float64, losses: Float64, injected: Mask) -> CMAES:
        """Return a copy that was told z (n, d), only part of a generation, of weights for n."""
        other = copy.copy(self)  # arrays are replaced, never written to
        other._two_point = None  # whose pair may still be out, and is drawn once
        other._set_weights(self.dim, len(z))
        other.tell(z, losses, injected)
        return other

    def _lengths(self, y: Float64) -> Float64:
        """Mahalanobis lengths (n,) of steps (n, d): |C^(-1/2) y|."""
        lengths: Float64 = np.linalg.norm((y @ self._B) / self._D, axis=-1)
        return lengths

    def _steps(self, z: Float64, injected: Mask) -> tuple[Float64, Float64]:
        """Steps y (k, d), injected ones cut, and their Mahalanobis lengths (k,)."""
        y = (z - self.mean) / self.sigma  # ~ N(0, C) where not injected
        lengths = self._lengths(y)
        too_long = injected & (lengths > self._longest_step)
        cut = np.where(too_long, self._longest_step / np.maximum(lengths, _TINY), 1.0)
        return y * cut[:, None], lengths * cut

    def shortened(self, z: Float64) -> Float64:
        """Candidates z (n, d) that are too far for samples, as near as samples may be."""
        y, _ = self._steps(z, np.ones(len(z), bool))
        shortened: Float64 = self.mean + self.sigma * y
        return shortened

    def _adapt(self, y: Float64, y_w: Float64, lengths: Float64) -> None:
        """Both evolution paths, and C by its rank-one and rank-mu update (eqs. 46 and 47).

        A scale of C that has drifted goes to sigma; the distribution is the same to the bit.
        """
        z_w = self._B @ ((y_w @ self._B) / self._D)  # C^(-1/2) y_w
        c, mu_eff = self._c_sigma, self._mu_eff
        self.p_sigma = (1 - c) * self.p_sigma + np.sqrt(c * (2 - c) * mu_eff) * z_w  # eq. 43
        discount = np.sqrt(1 - (1 - c) ** (2 * (self.generation + 1)))
        long_path = bool(
            np.linalg.norm(self.p_sigma) / discount >= (1.4 + 2 / (self.dim + 1)) * self._chi
        )
        c = self._c_c
        self.p_c = (1 - c) * self.p_c  # eq. 45
        if not long_path:  # else it pauses
            self.p_c = self.p_c + np.sqrt(c * (2 - c) * mu_eff) * y_w
        shrink = self.dim / (lengths**2 + 1e-8)
        w = self._weights * np.where(self._weights >= 0, 1.0, shrink)
        pause = c * (2 - c) if long_path else 0.0
        keep = 1 + self._c_1 * pause - self._c_1 - self._c_mu * self._weights.sum()
        rank_one = np.outer(self.p_c, self.p_c)
        C = keep * self.C + self._c_1 * rank_one + self._c_mu * (y.T * w) @ y
        self.C = (C + C.T) / 2  # the last product is symmetric but for rounding
        scale = np.sqrt(np.trace(self.C) / self.dim)
        if not 1 / _FARTHEST <= scale <= _FARTHEST:
            power = float(2.0 ** np.round(np.log2(scale)))
            self.sigma *= power
            self.p_c, self.C, self._D = self.p_c / power, self.C / power**2, self._D / power

    def _scale_sigma(self, factor: float) -> None:
        self.sigma = float(np.clip(self.sigma * factor, _SMALLEST_SIGMA, _LARGEST_SIGMA))

    def _decompose(self) -> None:
        """B and D of C, which is symmetric and kept positive definite."""
        eigenvalues, self._B = np.linalg.eigh(self.C)
        floor = max(eigenvalues[-1], _TINY) / _LARGEST_CONDITION
        if eigenvalues[0] < floor:
            eigenvalues = np.maximum(eigenvalues, floor)
            self.C = (self._B * eigenvalues) @ self._B.T
            self.C = (self.C + self.C.T) / 2
        self._D = np.sqrt(eigenvalues)

    def load_state_dict(self, state: Plain, sides: Sides | None = None) -> None:
        """Go on, bit for bit, where `state_dict` was taken; ValueError if it is none."""
        if (state.get("two_point") is None) != (self._two_point is None):
            raise ValueError("distribution['two_point'] is not of so many parameters")
        super().load_state_dict(state, {"d": self.dim})
