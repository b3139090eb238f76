"""Nevergrad's standardized space as a unit cube, and back.

Nevergrad describes each parametrization by a vector z in R^d: zero is the initial value, and one is
the step size (sigma) of the parametrization.  FIDE searches x in [0, 1]^d.  For each axis:

======================  =============================  ============================================
bounds of the axis      x of z                         property
======================  =============================  ============================================
l < u                   (z - l) / (u - l)              linear
none                    1/2 + arctan(pi z / 6) / pi    slope 1/6 at z = 0, and all of R is reached
l only                  2/pi arctan(pi (z - l) / 12)   slope 1/6 at the bound
u only                  1 - 2/pi arctan(pi (u - z) / 12)
======================  =============================  ============================================

For ``ng.p.Array(shape=..., lower=0, upper=1)``, whose sigma is a sixth of its range, the bounds are
those of the cube, and the search begins as that of FIDE alone: in the middle, with a standard
deviation of 1/6.  In general it begins at x(0), with the slope dx/dz there as standard deviation,
but at most 1/3.

Axes whose bounds are at infinity in standardized space (methods `arctan` and `tanh`) count as
unbounded, and so do the weights of a `Choice`.

An initial value that a user has chosen is a guess, which FIDE asks first.  Nevergrad chooses the
middle of two bounds, and zero without bounds.  In standardized space each initial value is zero, so
whether it was zero before is read from `_value` of the leaves: there is no public way.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from nevergrad.parametrization import helpers

from fide_plugins.types import Float64

__all__ = ["Cube", "initial_candidate"]

_SLOPE = 1 / 6
_WIDEST_STD = 1 / 3
_FARTHEST = 1e6  # steps to a bound; one that is farther away is ignored
_NARROWEST = 1e-6  # steps between two bounds; closer ones are ignored
_EDGE = 1e-9  # width at the end of an unbounded axis that is left out; 6e8 steps from its middle
_INWARDS = 1e-12  # of a range, in case that rounding puts a bound outside


class Cube:
    """The unit cube of one parametrization.

    mean, std: (d,), mean and standard deviation with which the first search begins.
    guess: mean where a user has chosen the initial value; None where Nevergrad has.
    """

    def __init__(self, parametrization: Any) -> None:
        lower, upper = _bounds(parametrization)
        has_lower, has_upper = np.isfinite(lower), np.isfinite(upper)
        self._box = has_lower & has_upper
        self._is_box = bool(self._box.all())
        self._low = np.where(has_lower, lower, 0.0)
        self._range = np.where(self._box, upper - self._low, 1.0)
        self._free = ~has_lower & ~has_upper
        self._sign = np.where(has_upper & ~has_lower, -1.0, 1.0)
        self._bound = np.where(has_lower, self._low, np.where(has_upper, upper, 0.0))
        zero = np.zeros(len(lower))
        self.mean = self.to_cube(zero)
        self.std = np.minimum(self._slope(), _WIDEST_STD)
        middle = np.isclose(self.mean, 0.5, rtol=0, atol=1e-12)
        self.mean[middle] = 0.5
        self.std[np.isclose(self.std, _SLOPE, rtol=1e-12)] = _SLOPE
        given = not middle.all() or bool((self._free & (_initial(parametrization) != 0)).any())
        self.guess = self.mean if given else None

    @property
    def dim(self) -> int:
        """Number of axes d."""
        return len(self._low)

    def to_cube(self, z: Float64) -> Float64:
        """Point x (d,) of the cube for standardized data z (d,), which is clipped to the bounds."""
        box: Float64 = np.clip((z - self._low) / self._range, 0.0, 1.0)
        if self._is_box:
            return box
        free = 0.5 + np.arctan(np.pi * _SLOPE * z) / np.pi
        half = 2 / np.pi * np.arctan(np.pi / 2 * _SLOPE * np.maximum(self._beyond_bound(z), 0.0))
        half = np.where(self._sign > 0, half, 1.0 - half)
        return np.where(self._box, box, np.where(self._free, free, half))

    def from_cube(self, x: Float64) -> Float64:
        """Standardized data z (d,) for a point x (d,) of the cube."""
        box: Float64 = self._low + x * self._range
        if self._is_box:
            return box
        inside = np.clip(x, _EDGE, 1.0 - _EDGE)
        free = np.tan(np.pi * (inside - 0.5)) / (np.pi * _SLOPE)
        from_bound = np.minimum(np.where(self._sign > 0, x, 1.0 - x), 1.0 - _EDGE)
        half = self._bound + self._sign * np.tan(np.pi / 2 * from_bound) / (np.pi / 2 * _SLOPE)
        return np.where(self._box, box, np.where(self._free, free, half))

    def _beyond_bound(self, z: Float64) -> Float64:
        return self._sign * (z - self._bound)

    def _slope(self) -> Float64:
        """dx/dz at z = 0, (d,)."""
        distance = np.pi / 2 * _SLOPE * self._beyond_bound(np.zeros(self.dim))
        half = _SLOPE / (1.0 + distance**2)
        return np.where(self._box, 1.0 / self._range, np.where(self._free, _SLOPE, half))


def initial_candidate(parametrization: Any) -> Any:
    """Candidate with the initial value, in which no choice is drawn anew."""
    candidate = parametrization.spawn_child()
    leaves = zip(helpers.list_data(candidate), helpers.list_data(parametrization), strict=True)
    for leaf, initial in leaves:
        if not np.array_equal(leaf.value, initial.value):
            leaf.value = initial.value
    return candidate


def _initial(parametrization: Any) -> Float64:
    """Initial values (d,) of the leaves, before bounds and logarithms."""
    values = [np.ravel(leaf._value) for leaf in helpers.list_data(parametrization)]
    nothing = np.zeros(parametrization.dimension)
    joined: Float64 = np.concatenate(values) if values else nothing
    return joined if joined.shape == nothing.shape else nothing


def _bounds(parametrization: Any) -> tuple[Float64, Float64]:
    """Lower and upper bounds (d,) in standardized space, infinite where there are none."""
    leaves = helpers.list_data(parametrization)  # in the order of the standardized data
    dim = parametrization.dimension
    if sum(leaf.dimension for leaf in leaves) != dim:  # an unknown kind of parameter
        return np.full(dim, -np.inf), np.full(dim, np.inf)
    ends = [[_end(leaf, bound) for bound in leaf.bounds] for leaf in leaves]
    first, second = (np.concatenate(side) for side in zip(*ends, strict=True))
    # zero lies between the bounds; an operation such as a minus sign may have swapped them
    swapped = (first > 0) | (second < 0)
    lower, upper = np.where(swapped, second, first), np.where(swapped, first, second)
    periodic = upper - lower < _NARROWEST  # the bounds of an angle are the same point
    lower[periodic | np.isnan(lower)] = -np.inf
    upper[periodic | np.isnan(upper)] = np.inf
    return lower, upper


def _end(leaf: Any, bound: Any) -> Float64:
    """One of the bounds of a leaf in its standardized space; NaN where it has none."""
    nowhere: Float64 = np.full(leaf.dimension, np.nan)
    if bound is None:
        return nowhere
    inside = np.asarray(leaf.value, np.float64)
    value = np.broadcast_to(np.ravel(bound)[0] if inside.ndim == 0 else bound, inside.shape)
    for fraction in (0.0, _INWARDS):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # infinity is expected here
                z = _standardized(leaf, value + fraction * (inside - value))
        except ValueError:
            continue
        if z.shape == nowhere.shape:
            return np.where(np.abs(z) < _FARTHEST, z, np.nan)
    return nowhere


def _standardized(leaf: Any, value: Float64) -> Float64:
    child = leaf.spawn_child(new_value=value if value.ndim else float(value))
    return np.asarray(child.get_standardized_data(reference=leaf), np.float64)
