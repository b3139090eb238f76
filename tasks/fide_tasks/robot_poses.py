"""Which poses of the Panda make good targets, and the camera that sees them.

Links are taken as capsules, [p, q, r]: all points within r of the line from p to q, in m. They are
looked at in points along their lines, so that what is said here holds roughly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fide_tasks import panda
from fide_tasks.base import Vector

LOOK_AT = (0.0, 0.0, 0.48)  # m; the middle of the image
DISTANCE = 2.5  # m of the camera from there
AZIMUTH, ELEVATION = 145.0, -18.0  # degrees; where it looks: from X toward Y, and up
FOV = 46.0  # degrees, across the shorter side of the image

_MARGIN = 0.94  # of the half image, within which all of the arm is
_IN_SIGHT = 0.85  # share of the arm that no other link hides
_ASIDE = 0.5  # least sine of the angle between a long link and the line of sight
_CLEARANCE = 0.02  # m
_POINTS = 9  # along a link
_ABOVE_FLOOR = 0.0  # m


class _Link(NamedTuple):
    p: Vector
    q: Vector
    r: float

    @property
    def points(self) -> Vector:
        """Points along its line, (n, 3)."""
        s = np.linspace(0, 1, _POINTS)[:, None]
        return (1 - s) * self.p + s * self.q


def is_good(q: Vector) -> bool:
    """Whether the arm with joint angles q, (7,), is free, and is seen well."""
    links = _links(q)
    return _is_free(links) and _is_seen(links)


def _links(q: Vector) -> list[_Link]:
    """Column, upper arm, elbow, forearm, wrist, hand and its width; neighbors touch."""
    poses = panda.frames(q)
    origin = poses[:, :3, 3]
    at = [pose[:3, :3] for pose in poses]
    upper = origin[3] - 0.0825 * at[3][:, 0]  # the upper arm's line, at the height of the elbow
    fore = origin[3] - 0.0825 * at[3][:, 0]
    tip = origin[7] + panda.HAND * at[7][:, 2]
    spread = 0.09 * (at[7] @ [np.sqrt(0.5), np.sqrt(0.5), 0.0])  # the hand is turned by 45 degrees
    palm = origin[7] + 0.04 * at[7][:, 2]
    return [
        _Link(np.array([-0.12, 0.0, 0.05]), np.array([0.03, 0.0, 0.05]), 0.1),
        _Link(np.zeros(3), origin[0], 0.09),
        _Link(origin[1], upper, 0.075),
        _Link(upper, origin[3], 0.07),
        _Link(fore, origin[4], 0.075),
        _Link(origin[5], origin[6], 0.065),
        _Link(origin[6], tip, 0.05),
        _Link(palm - spread, palm + spread, 0.035),
    ]
