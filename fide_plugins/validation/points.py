"""Validates points of the unit cube, seeds, and standard deviations."""

from __future__ import annotations

import operator
from collections.abc import Mapping
from numbers import Real
from typing import Any

import numpy as np
import numpy.typing as npt

from fide_plugins.errors import OptionError, PointsError, SpaceError
from fide_plugins.types import Float64

_MOST_PARAMETERS = 10_000  # a matrix of so many rows and columns has 0.8 GB


def as_points(X: object, dim: int) -> Float64:
    """`X` as float64 (n, dim), a copy; PointsError unless real, finite and within [0, 1]."""
    if hasattr(X, "detach"):  # a torch tensor, perhaps on another device
        X = X.detach().cpu()
    try:
        points: npt.NDArray[Any] = np.asarray(X)
    except (TypeError, ValueError, RuntimeError) as error:
        raise PointsError(f"X must be an array of shape (n, {dim}): {error}") from error
    if points.dtype.kind not in "fiub":
        raise PointsError(f"X must hold real numbers, not {points.dtype}")
    if points.ndim != 2 or points.shape[1] != dim:
        hint = "; for one point pass x[None]" if points.shape == (dim,) else ""
        raise PointsError(f"X must have the shape (n, {dim}), not {points.shape}{hint}")
    inside = (points >= 0.0) & (points <= 1.0)  # False for NaN too
    if not inside.all():
        row, column = np.argwhere(~inside)[0]
        raise PointsError(
            f"every value of X must lie in [0, 1], but X[{row}, {column}] = "
            f"{points[row, column]}; scale your parameters to the unit cube"
        )
    return np.array(points, np.float64, order="C")


def as_point(x: Any, dim: int, name: str = "x") -> Float64:
    """`x` as float64 (dim,), a copy; name: of `x` in errors; raises as `as_points` does."""
    try:
        shape: tuple[int, ...] = np.shape(x)
    except (TypeError, ValueError, RuntimeError):  # no array at all
        shape = (dim,)
    if shape != (dim,):
        got = shape[0] if len(shape) == 1 else f"the shape {shape}" if shape else "one number"
        raise PointsError(f"{name} must have {dim} numbers, not {got}")
    point: Float64 = as_points([x], dim)[0]
    return point


def as_real(value: object) -> float | None:
    """`value` as a float; None unless it is a real number, NumPy's too; a bool is none."""
    try:
        real = isinstance(value, Real) and not isinstance(value, bool)
        return float(value) if real else None  # type: ignore[arg-type]
    except OverflowError:
        return None


def as_whole(value: Any) -> int | None:
    """`value` as an int; None unless it is an integer, NumPy's too; a bool is none."""
    try:
        return None if isinstance(value, bool | np.bool_) else operator.index(value)
    except TypeError:
        return None


def whole_number(name: str, value: object, minimum: int) -> int:
    """`value` as an int; OptionError (a ValueError) unless it is a whole number >= `minimum`."""
    number = as_whole(value)
    if number is None or number < minimum:
        whole = isinstance(value, float) and value.is_integer() and value >= minimum
        hint = f"; write {value:.0f}" if whole else ""
        raise OptionError(f"{name} must be a whole number >= {minimum}, not {value!r}{hint}")
    return number


def number_of_parameters(name: str, value: object) -> int:
    """`value` as an int; OptionError (a ValueError) for what is neither that nor a `Space`."""
    try:
        number = whole_number(name, value, 1)
    except OptionError:
        raise OptionError(
            f"{name} must be a Space, or the number of parameters, a whole number >= 1, not "
            f"{value!r}; Space(...) takes a dictionary, too, and Space.read(path) a file"
        ) from None
    if number > _MOST_PARAMETERS:
        raise OptionError(
            f"{name} must be at most {_MOST_PARAMETERS:,} parameters, not {number:,}: the search "
            "keeps matrices of dim x dim numbers; fit the picture in parts"
        )
    return number


def new_seed(seed: object) -> int:
    """`seed`, checked; for None a fresh 128-bit seed from the operating system."""
    if seed is None:
        entropy = np.random.SeedSequence().entropy
        return int(entropy) if isinstance(entropy, int) else 0
    return whole_number("seed", seed, 0)


def torch_seed(seed: object) -> int:
    """`seed`, checked as `new_seed` does, in the range that PyTorch takes: modulo 2^63."""
    return new_seed(seed) % 2**63


_SMALLEST_STD = 1e-16  # a smaller one cannot change doubles near the center of the cube


def standard_deviations(value: Any, dim: int) -> float | Float64:
    """`value` as a float or as floats (dim,); OptionError unless all lie in [1e-16, 1]."""
    single = not isinstance(value, list | tuple) and np.ndim(value) == 0
    if not single and len(value) != dim:
        raise OptionError(f"sigma0 must be one number or {dim}, not {value!r}")
    given = [value.item() if hasattr(value, "item") else value] if single else value
    numbers = [as_real(one) or 0.0 for one in given]
    for number, one in zip(numbers, given, strict=True):
        if not _SMALLEST_STD <= number <= 1:
            raise OptionError(f"sigma0 must lie in (0, 1], at least {_SMALLEST_STD}, not {one!r}")
    return numbers[0] if single else np.array(numbers)


def starting_point(value: object, dim: int, space: Any = None) -> Float64:
    """`value` as float64 (dim,), for None the center of the cube.

    space: with it, `value` may be a dictionary of parameters.  Raises PointsError, SpaceError.
    """
    if value is None:
        return np.full(dim, 0.5)
    if not isinstance(value, Mapping):
        try:
            return as_point(value, dim, "it")
        except PointsError as error:
            hint = "" if space is None else "; to give values, pass a dictionary of them"
            rule = f"x0 must be a point of the cube, (dim,) = ({dim},): {error}{hint}"
            raise PointsError(rule) from error
    if space is None:
        raise PointsError(
            "x0 is a dictionary of parameters, which needs a Space of them in place of their "
            "number; or give a point of the cube"
        )
    try:
        point: Float64 = space.encode(value)
    except SpaceError as error:
        raise SpaceError(f"x0: {error}") from error
    return point
