"""Nevergrad's parametrizations as a `fide_plugins.Space`, and candidates as points of its cube.

========================================  ==========================================================
part of a parametrization (a leaf)        parameters of the space
========================================  ==========================================================
`Choice` of 2 to 1,000 values             a `Choice` for each repetition
whole numbers between two bounds, and     an `Int` for each, with log for those of `Log`
`TransitionChoice`
`Angles`                                  a periodic `Float` for each
all others, also logarithms               a `Float` for each axis, as below
========================================  ==========================================================

The first three are read and written as values.  The others by Nevergrad's standardized data z: zero
is the initial value, and one is the step size (sigma) of the parametrization.  For each axis:

======================  =============================  ============================================
bounds of the axis      x of z                         property
======================  =============================  ============================================
l < u                   (z - l) / (u - l)              linear
none                    1/2 + arctan(pi z / 6) / pi    slope 1/6 at z = 0, and all of R is reached
l only                  2/pi arctan(pi (z - l) / 12)   slope 1/6 at the bound
u only                  1 - 2/pi arctan(pi (u - z) / 12)
======================  =============================  ============================================

The search begins at x(0), with the slope dx/dz there as standard deviation, but at most 1/3.  Axes
whose bounds are at infinity in standardized space (methods `arctan` and `tanh`) are unbounded.

An initial value that a user has chosen is a guess, which FIDE asks first; the middle of two bounds,
or zero without bounds, is Nevergrad's.  It is read from `_value` of the leaves: no public way is.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from nevergrad.parametrization import helpers, parameter as p

from fide_plugins.errors import SpaceError
from fide_plugins.space import Choice, Float, Int, Kind, Space
from fide_plugins.types import Float64

_SLOPE = 1 / 6
_WIDEST_STD = 1 / 3
_FARTHEST = 1e6  # steps to a bound; one that is farther away is ignored
_NARROWEST = 1e-6  # steps between two bounds; closer ones are ignored
_EDGE = 1e-9  # width at the end of an unbounded axis that is left out; 6e8 steps from its middle
_INWARDS = 1e-12  # of a range, in case that rounding puts a bound outside
_MOST_CHOICES = 1000  # of a `Choice`
_UNIT = Float(0, 1)


class Cube:
    """The unit cube of one parametrization.

    space: of its parameters, which are called p0, p1, ...; None if there are none.
    std: (dim,), standard deviation with which the first search begins.
    guess: (dim,), the initial value where a user has chosen it; None where Nevergrad has.
    """

    def __init__(self, parametrization: Any) -> None:
        self._parametrization = parametrization
        leaves = _leaves(parametrization)
        axes = _Axes(*_bounds(leaves, parametrization.dimension))
        numeric = np.ones(axes.dim, bool)  # axes of z that are read and written as such
        values = [np.ravel(leaf._value) for leaf in leaves] or [np.zeros(axes.dim)]
        initial = abs(np.concatenate(values)) > _EDGE
        given = axes.off_center | (axes.free & initial)
        parts = (each for _, each in helpers.flatten(parametrization))
        choices = {id(each.indices): each for each in parts if isinstance(each, p.BaseChoice)}
        kinds: list[Kind] = []
        stds: list[Float64] = []
        self._by_value: list[tuple[int, slice]] = []  # other leaves, and columns of their values
        end = 0
        for i, leaf in enumerate(leaves):
            z = slice(end, end := end + leaf.dimension)
            choice = choices.get(id(leaf))
            found = _kinds(leaf, choice)
            kinds += found or [_UNIT] * leaf.dimension
            if not found or (choice is None and isinstance(found[0], Int)):
                stds.append(axes.std[z])
            else:
                stds.append(np.full(sum(kind.width for kind in found), _SLOPE))
                given[z] = initial[z] if choice is not None else bool(np.any(leaf.value))
            if found:
                numeric[z] = False
                self._by_value.append((i, slice(len(kinds) - len(found), len(kinds))))
        if not leaves:  # an unknown kind of parameter
            kinds, stds = [_UNIT] * axes.dim, [axes.std]
        self.space = Space({f"p{i}": kind for i, kind in enumerate(kinds)}) if kinds else None
        self.std = np.concatenate(stds)
        self._numeric = numeric
        self._columns = np.ones(len(kinds), bool)
        for _, columns in self._by_value:
            self._columns[columns] = False
        self._axes = _Axes(axes.lower[numeric], axes.upper[numeric])
        self.guess = self.point(parametrization) if given.any() else None

    def candidate(self, x: Float64) -> Any:
        """New candidate for a point x (dim,) of the cube."""
        made, numbers = self._parametrization.spawn_child(), x
        if self._by_value and self.space is not None:
            numbers = self.space.layout.numbers(x[None])[0]
        z = np.zeros(len(self._numeric))
        z[self._numeric] = self._axes.from_cube(numbers[self._columns])
        made.set_standardized_data(z, reference=self._parametrization)
        leaves = helpers.list_data(made) if self._by_value else []
        for i, columns in self._by_value:
            _assign(leaves[i], numbers[columns])
        return made

    def point(self, candidate: Any) -> Float64:
        """Point x (dim,) of the cube for a candidate; standardized data are clipped to bounds."""
        z = candidate.get_standardized_data(reference=self._parametrization)
        if not self._by_value or self.space is None:
            return self._axes.to_cube(z)
        numbers = np.empty((1, len(self._columns)))
        numbers[0, self._columns] = self._axes.to_cube(z[self._numeric])
        leaves = helpers.list_data(candidate)
        for i, columns in self._by_value:
            numbers[0, columns] = np.ravel(leaves[i].value)
        return np.asarray(self.space.layout.points(numbers)[0])


class _Axes:
    """Axes of standardized data."""

    def __init__(self, lower: Float64, upper: Float64) -> None:
        self.lower, self.upper, self.dim = lower, upper, len(lower)
        has_lower, has_upper = np.isfinite(lower), np.isfinite(upper)
        self._box = has_lower & has_upper
        self._is_box = bool(self._box.all())
        self._low = np.where(has_lower, lower, 0.0)
        self._range = np.where(self._box, upper - self._low, 1.0)
        self.free = ~has_lower & ~has_upper
        self._sign = np.where(has_upper & ~has_lower, -1.0, 1.0)
        self._bound = np.where(has_lower, self._low, np.where(has_upper, upper, 0.0))
        zero = np.zeros(self.dim)
        self.off_center = ~np.isclose(self.to_cube(zero), 0.5, rtol=0, atol=1e-12)
        distance = np.pi / 2 * _SLOPE * self._beyond_bound(zero)
        half = _SLOPE / (1.0 + distance**2)
        slope = np.where(self._box, 1.0 / self._range, np.where(self.free, _SLOPE, half))
        self.std = np.minimum(slope, _WIDEST_STD)
        self.std[np.isclose(self.std, _SLOPE, rtol=1e-12)] = _SLOPE

    def to_cube(self, z: Float64) -> Float64:
        """Coordinates (d,) in [0, 1] for standardized data z (d,)."""
        box: Float64 = np.clip((z - self._low) / self._range, 0.0, 1.0)
        if self._is_box:
            return box
        free = 0.5 + np.arctan(np.pi * _SLOPE * z) / np.pi
        half = 2 / np.pi * np.arctan(np.pi / 2 * _SLOPE * np.maximum(self._beyond_bound(z), 0.0))
        half = np.where(self._sign > 0, half, 1.0 - half)
        return np.where(self._box, box, np.where(self.free, free, half))

    def from_cube(self, x: Float64) -> Float64:
        """Standardized data (d,) for coordinates x (d,)."""
        box: Float64 = self._low + x * self._range
        if self._is_box:
            return box
        inside = np.clip(x, _EDGE, 1.0 - _EDGE)
        free = np.tan(np.pi * (inside - 0.5)) / (np.pi * _SLOPE)
        from_bound = np.minimum(np.where(self._sign > 0, x, 1.0 - x), 1.0 - _EDGE)
        half = self._bound + self._sign * np.tan(np.pi / 2 * from_bound) / (np.pi / 2 * _SLOPE)
        return np.where(self._box, box, np.where(self.free, free, half))

    def _beyond_bound(self, z: Float64) -> Float64:
        return self._sign * (z - self._bound)


# -- values ----------------------------------------------------------------------------------------


def _kinds(leaf: Any, choice: Any) -> list[Kind]:
    """What the values of a leaf are; [] where it is read and written by its standardized data."""
    if isinstance(choice, p.Choice):
        n = len(choice)
        return [Choice(*range(n))] * (leaf.dimension // n) if 1 < n <= _MOST_CHOICES else []
    if any(bound is None for bound in leaf.bounds):
        return []
    shape = np.shape(leaf.value)
    ends = np.sort([np.ravel(np.broadcast_to(_of_shape(b, shape), shape)) for b in leaf.bounds], 0)
    try:
        if leaf.integer and leaf.dimension == ends.shape[1]:
            ends = np.round(ends + np.array([[0.5 - _INWARDS], [_INWARDS - 0.5]]))  # as Nevergrad
            is_log = isinstance(leaf, p.Log)
            return [Int(int(low), int(high), log=is_log) for low, high in ends.T]
        # an angle is two numbers in standardized data
        turns = (ends[1] - ends[0]) / (2 * np.pi), (ends[1] - ends[0]) / 360
        if leaf.dimension == 2 * ends.shape[1] and any(np.allclose(t, 1) for t in turns):
            return [Float(low, high, periodic=True) for low, high in ends.T]
    except (SpaceError, OverflowError):  # one value only, too many, or no end
        pass
    return []


def _assign(leaf: Any, numbers: Float64) -> None:
    """Give a leaf of a candidate its values."""
    inside = leaf.value
    values = numbers.astype(np.int64) if leaf.integer else numbers
    value = values.reshape(np.shape(inside)) if np.ndim(inside) else values[0].item()
    try:
        leaf.value = value
    except ValueError:  # the logarithm of a bound is rounded to the outside
        leaf.value = value + _INWARDS * (inside - value)


def _of_shape(bound: Any, shape: tuple[int, ...]) -> Any:
    """A bound for values of a shape; that of a number is an array of one."""
    return np.ravel(bound)[0] if shape == () else bound


def initial_candidate(parametrization: Any) -> Any:
    """Candidate with the initial value, in which no choice is drawn anew."""
    candidate = parametrization.spawn_child()
    leaves = zip(helpers.list_data(candidate), helpers.list_data(parametrization), strict=True)
    for leaf, initial in leaves:
        if not np.array_equal(leaf.value, initial.value):
            leaf.value = initial.value
    return candidate


# -- standardized data -----------------------------------------------------------------------------


def _leaves(parametrization: Any) -> list[Any]:
    """Parts in the order of the standardized data; [] for an unknown kind of parametrization."""
    leaves: list[Any] = helpers.list_data(parametrization)
    known = sum(leaf.dimension for leaf in leaves) == parametrization.dimension
    return leaves if known else []


def _bounds(leaves: list[Any], dim: int) -> tuple[Float64, Float64]:
    """Lower and upper bounds (d,) in standardized space, infinite where there are none."""
    if not leaves:
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
    value = np.broadcast_to(_of_shape(bound, inside.shape), inside.shape)
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
