"""Features of the images that a proposer remembers, and their scalar products.

A buffer holds one subset of the channels, of the tokens that vary.

Notation
--------
=======  ==============  ===================================================================
symbol   shape           meaning
=======  ==============  ===================================================================
e        (n, T, C)       features of the images that are remembered
o        (T, C)          an origin; products of deviations from it lose few digits
G        (n, n)          (e - o) (e - o)^T, over tokens and channels
=======  ==============  ===================================================================

**Token selection.**  A patch that shows the same in every image that is remembered adds the same
number to all entries of G, and to all products with the target, whatever the target shows there;
the regression, which looks at differences, sees nothing of it.  So such tokens are left out: the
background of a robot, or what a search that has narrowed down no longer moves.  Left out are as
many tokens, those that vary least, as hold a share `NEGLIGIBLE` of the variance together, which
changes no product by more than the root of that share.

The choice follows the images.  A token that was left out was, up to that share, at its origin in
every image that is remembered; so it comes back with the first image in which it has moved, with
zeros for the older ones, and nothing was lost.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

from fide_plugins.runtime.schema import Schema, array, check, whole
from fide_plugins.types import Float64, Indices, Mask

__all__ = ["MOST", "NEGLIGIBLE", "FeatureBuffer", "for_jacobian"]


MOST = 600
"""Candidates: each generation costs a regression on as many."""


def for_jacobian(dim: int) -> int:
    """Candidates to which a Jacobian of d parameters is fitted: 4 d + 20, at most `MOST`.

    >>> for_jacobian(8), for_jacobian(200)
    (52, 600)
    """
    return min(4 * dim + 20, MOST)


NEGLIGIBLE = 1e-6
_SCHEMA: Schema = {
    "features": array("n", "f", low=-1e60, high=1e60),
    "gram": array("n", "n", low=-1e125, high=1e125),
    "origin": array("t", "c", low=-1e60, high=1e60),
    "used": array("t", kind="b"),
    "unchecked": whole(),
}
_FEW = 8  # leaving out fewer than one in so many is not worth the copy


class FeatureBuffer:
    """One channel subset: features of the images that are remembered, and their products.

    channels: so many leading ones; None: all.
    select: leave out tokens that do not vary.
    """

    def __init__(self, channels: int | None, select: bool = True) -> None:
        self.channels, self.select = channels, select
        self.features: Float64 = np.empty((0, 0))  # (n, f), deviations, of the tokens in use
        self.gram: Float64 = np.empty((0, 0))  # (n, n)
        self.origin: Float64 = np.empty((0, 0))  # (T, C)
        self.used: Mask = np.empty(0, bool)  # (T,), the tokens that are not left out
        self._unchecked = 0  # images since it was last seen which tokens vary
        self._toward: tuple[Tensor, Float64] | None = None  # a target, its products with all images

    @property
    def tokens(self) -> int:
        """How many tokens are in use."""
        return int(self.used.sum())

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
        self._forget(max(0, len(self.features) + len(deviations) - capacity))
        if self.select:
            self._take_up(deviations)
        new = self._flat(deviations)
        cross = new @ self.features.T
        self.gram = np.block([[self.gram, cross.T], [cross, new @ new.T]])
        self.features = np.concatenate([self.features, new])
        self._unchecked += len(new)
        if self.select and self._unchecked >= len(self.features):  # once for every set of images
            self._leave_out()
            self._unchecked = 0

    def products(self, target: Tensor, sources: Indices) -> Float64:
        """(e* - e_i) . e_j for the sources i and all j, (m, n)."""
        if self._toward is None or self._toward[0] is not target:
            wanted = self._flat(self._seen(target[None]) - self.origin)[0]
            self._toward = target, self.features @ wanted  # (n,)
        missing: Float64 = self._toward[1] - self.gram[sources]
        return missing

    def missing(self, target: Tensor, source: int) -> Float64:
        """e* - e_i for the source i, (f,), in the tokens in use."""
        wanted = self._flat(self._seen(target[None]) - self.origin)[0]
        missing: Float64 = wanted - self.features[source]
        return missing

    def keep(self, which: Indices) -> None:
        """Forget all images but these (n,), in that order."""
        self._toward = None
        self.gram, self.features = self.gram[np.ix_(which, which)], self.features[which]

    def _seen(self, tokens: Tensor) -> Float64:
        """Tokens (m, T, C) without the channels of other subsets."""
        return tokens.detach()[..., : self.channels].cpu().numpy().astype(np.float64)

    def _flat(self, deviations: Float64) -> Float64:
        """Features (m, f) of deviations (m, T, C): those of the tokens in use."""
        return _rows(np.ascontiguousarray(deviations[:, self.used]))

    def _forget(self, n: int) -> None:
        """Drop the n oldest images."""
        self.gram, self.features = self.gram[n:, n:], self.features[n:]

    def _take_up(self, deviations: Float64) -> None:
        """Use the tokens that vary in new images, deviations (m, T, C), too."""
        if self.used.all():
            return
        moved = ~_negligible(_energy(deviations))
        if (moved & ~self.used).any():
            self._use(moved | self.used)

    def _leave_out(self) -> None:
        """Use those tokens no more that vary in none of the images, if they are not just a few."""
        features = self._by_token(self.features)
        means = features.mean(axis=0)
        still = _negligible(_energy(features - means))
        if _FEW * still.sum() <= still.size:
            return
        left_out = _rows(features[:, still])
        self.gram = self.gram - left_out @ left_out.T
        used = self.used.copy()
        used[self.used] = ~still
        self.origin = self.origin.copy()
        self.origin[self.used & ~used] += means[still]
        self._use(used)

    def _use(self, used: Mask) -> None:
        """Change the tokens in use to these (T,); those that come were at their origin."""
        features = np.zeros((len(self.features), int(used.sum()), self.origin.shape[1]))
        features[:, self.used[used]] = self._by_token(self.features)[:, used[self.used]]
        self.features, self.used = _rows(features), used

    def _by_token(self, features: Float64) -> Float64:
        """(n, f) -> (n, tokens in use, C)."""
        return features.reshape(len(features), self.tokens, self.origin.shape[1])

    def state_dict(self) -> dict[str, Any]:
        """All that `add` changes."""
        return {
            "features": self.features,
            "gram": self.gram,
            "origin": self.origin,
            "used": self.used,
            "unchecked": self._unchecked,
        }

    def load_state_dict(self, state: Mapping[str, Any], n: int, tokens: int | None = None) -> None:
        """Put back what `state_dict` gave, of n images; ValueError if it is none.

        tokens: T, if that is known.
        """
        _check(state, n, tokens)
        self._toward = None
        self.features, self.gram = state["features"], state["gram"]
        self.origin, self.used = state["origin"], state["used"]
        self._unchecked = int(state["unchecked"])


def _rows(features: Float64) -> Float64:
    """(n, tokens, C) -> (n, f); also where there are none."""
    n, tokens, channels = features.shape
    return features.reshape(n, tokens * channels)


def _energy(deviations: Float64) -> Float64:
    """Sum of squares of each token, (T,), of deviations (n, T, C)."""
    energy: Float64 = np.einsum("ntc,ntc->t", deviations, deviations)
    return energy


def _negligible(energy: Float64) -> Mask:
    """Which tokens, those of least energy (T,), hold a share `NEGLIGIBLE` of it together."""
    order = np.argsort(energy, kind="stable")
    small: Mask = np.empty(len(energy), bool)
    small[order] = np.cumsum(energy[order]) <= NEGLIGIBLE * energy.sum()
    return small


def _check(state: Mapping[str, Any], n: int, tokens: int | None) -> None:
    """Raise ValueError unless `state` is of n images, with features of the tokens in use."""
    sides = {"n": n}
    check(state, _SCHEMA, sides, "feature buffer")
    if not n:
        return
    if tokens is not None and sides["t"] != tokens:
        raise ValueError(f"feature buffer has {sides['t']} tokens, not {tokens}")
    if sides["f"] != int(state["used"].sum()) * sides["c"]:
        raise ValueError(
            f"feature buffer has {sides['f']} features, not those of the tokens in use"
        )
