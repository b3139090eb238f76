"""How candidates are kept in the unit cube: reflection, as a change of coordinates.

A periodic parameter, such as an angle, has no walls: the ends of its axis are the same value.  Its
coordinate is taken modulo 1 instead.  A mask `periodic` (d,) says which these are; None: none.

The search distribution lives in R^d.  Its candidate z stands for the point `into(z)` of the unit
cube, the triangle wave of period 2 in every coordinate; what is rendered is that point, what the
distribution learns from is z itself.  So it optimizes the even, periodic continuation of the loss,
and every step it is told is one it drew: samples are exactly N(m, Sigma), none is clipped,
redrawn or moved, and the covariance is as unbiased as without bounds.  (Telling the repaired point
instead would shrink the covariance across a nearby wall.)

A candidate that comes from elsewhere, a proposal or a user's guess, is a point x of the cube and
has many z; `closest` takes the one closest to the mean.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.types import Float64, Mask

__all__ = ["closest", "distance", "inside", "into"]


def into(z: Float64, periodic: Mask | None = None) -> Float64:
    """Points of the unit cube that candidates `z` (..., d) stand for."""
    period = np.mod(z, 2.0)  # in [0, 2]
    x: Float64 = np.minimum(period, 2.0 - period)
    if periodic is not None:
        x = np.where(periodic & ((z < 0.0) | (z > 1.0)), np.mod(z, 1.0), x)
    return np.clip(x, 0.0, 1.0)


def inside(x: Float64, periodic: Mask | None = None) -> Float64:
    """Points (..., d) that somebody wants, in the unit cube: wrapped where periodic, or clipped."""
    if periodic is not None:
        x = np.where(periodic, into(x, periodic), x)
    return np.clip(x, 0.0, 1.0)


def distance(x: Float64, y: Float64, periodic: Mask | None = None) -> Float64:
    """Distances of coordinates x and y (..., d) of the cube, the shorter way where periodic."""
    apart: Float64 = np.abs(x - y)
    return apart if periodic is None else np.where(periodic, np.minimum(apart, 1.0 - apart), apart)


def closest(x: Float64, mean: Float64, periodic: Mask | None = None) -> Float64:
    """Return the z (n, d) with into(z) = x (n, d) that is closest to `mean` (d,)."""
    turn = 2.0 * np.round((mean - x) / 2.0)
    mirrored = -x + 2.0 * np.round((mean + x) / 2.0)
    direct = x + turn
    z: Float64 = np.where(np.abs(mirrored - mean) < np.abs(direct - mean), mirrored, direct)
    if periodic is not None:
        z = np.where(periodic, x + np.round(mean - x), z)
    return z
