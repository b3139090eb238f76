"""The Franka Emika Panda: joint limits, forward kinematics in closed form, poses for targets.

Notation: q [..., 7] joint angles in rad; T_i [..., 4, 4] pose of frame i in the base, lengths in m.
In Craig's convention of Denavit and Hartenberg, frame i is fixed to link i, and

    T_i = T_(i-1) Rx(alpha_(i-1)) Dx(a_(i-1)) Rz(q_i) Dz(d_i)

Source of all numbers: Franka Emika, "Robot and interface specifications",
https://frankaemika.github.io/docs/control_parameters.html (limits and parameters of the Panda).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fide_tasks.base import Vector

JOINTS = 7

LIMITS = (  # rad, of joints 1 to 7
    (-2.8973, 2.8973),
    (-1.7628, 1.7628),
    (-2.8973, 2.8973),
    (-3.0718, -0.0698),
    (-2.8973, 2.8973),
    (-0.0175, 3.7525),
    (-2.8973, 2.8973),
)

DH = (  # a_(i-1) in m, d_i in m, alpha_(i-1) in rad; of joints 1 to 7
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -math.pi / 2),
    (0.0, 0.316, math.pi / 2),
    (0.0825, 0.0, math.pi / 2),
    (-0.0825, 0.384, -math.pi / 2),
    (0.0, 0.0, math.pi / 2),
    (0.088, 0.0, math.pi / 2),
)

FLANGE = 0.107  # m from frame 7 along its z to the flange
HAND = 0.1034  # m from the flange along the same z to between the finger tips


def frames(q: Vector) -> Vector:
    """Poses of frames 1 to 7 and of the flange at angles q, (..., 7): (..., 8, 4, 4)."""
    poses = []
    T = np.eye(4)
    for i, (a, d, alpha) in enumerate(DH):
        T = T @ _link(a, d, alpha, q[..., i])
        poses.append(T)
    poses.append(T @ _link(0.0, FLANGE, 0.0, np.zeros(q.shape[:-1])))
    return np.stack(poses, axis=-3)


def _link(a: float, d: float, alpha: float, theta: Vector) -> Vector:
    """Rx(alpha) Dx(a) Rz(theta) Dz(d) for angles theta, (...): (..., 4, 4)."""
    c, s = np.cos(theta), np.sin(theta)
    ca, sa = math.cos(alpha), math.sin(alpha)
    T = np.zeros((*np.shape(theta), 4, 4))
    T[..., 0, 0], T[..., 0, 1], T[..., 0, 3] = c, -s, a
    T[..., 1, 0], T[..., 1, 1], T[..., 1, 2], T[..., 1, 3] = s * ca, c * ca, -sa, -d * sa
    T[..., 2, 0], T[..., 2, 1], T[..., 2, 2], T[..., 2, 3] = s * sa, c * sa, ca, d * ca
    T[..., 3, 3] = 1.0
    return T


# -- poses that make good targets, and the camera that sees them -----------------------------------
#
# Links are taken as capsules, [p, q, r]: all points within r of the line from p to q, in m. They
# are looked at in points along their lines, so that what is said here holds roughly.


LOOK_AT = (0.0, 0.0, 0.52)  # m; the middle of the image
DISTANCE = 2.2  # m of the camera from there
AZIMUTH, ELEVATION = 145.0, -18.0  # degrees; where it looks: from X toward Y, and up
FOV = 44.0  # degrees, across the shorter side of the image

_MARGIN = 0.94  # of the half image, within which all of the arm is
_IN_SIGHT = 0.85  # share of the arm that no other link hides
_ASIDE = 0.5  # least sine of the angle between a long link and the line of sight
_CLEARANCE = 0.02  # m
_POINTS = 9  # along a link
_UPPER, _ELBOW, _FOREARM, _HAND = 2, 3, 5, 7  # places in the list of links
_LONG = (_UPPER, _FOREARM, _HAND)


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
    """Base, column, upper arm, both halves of the elbow, forearm, wrist, hand, and its width."""
    poses = frames(q)
    origin, axis = poses[:, :3, 3], poses[:, :3, :3].swapaxes(1, 2)  # axis[i, k]: of frame i + 1
    forearm = origin[3] + DH[4][0] * axis[3, 0]  # where it begins, beside the elbow
    tip = origin[7] + HAND * axis[7, 2]
    palm = origin[7] + 0.04 * axis[7, 2]
    across = 0.09 * (axis[7, 0] + axis[7, 1]) / np.sqrt(2)  # the hand is turned by 45 degrees
    return [
        _Link(np.array([-0.12, 0.0, 0.05]), np.array([0.03, 0.0, 0.05]), 0.10),
        _Link(np.zeros(3), origin[0], 0.09),
        _Link(origin[1], origin[2], 0.075),
        _Link(origin[2], origin[3], 0.07),
        _Link(origin[3], forearm, 0.07),
        _Link(forearm, origin[4], 0.07),
        _Link(origin[5], origin[6], 0.06),
        _Link(origin[6], tip, 0.05),
        _Link(palm - across, palm + across, 0.035),
    ]


def _is_free(links: list[_Link]) -> bool:
    """Whether no link is in the floor or in another one, neighbors apart."""
    if any((link.points[:, 2] < link.r + _CLEARANCE).any() for link in links[_ELBOW:]):
        return False
    for i, one in enumerate(links):
        for j in range(i + 3, len(links)):
            if (i, j) == (_UPPER, _FOREARM):  # they are apart by construction
                continue
            gaps = np.linalg.norm(one.points[:, None] - links[j].points, axis=2)
            if gaps.min() < one.r + links[j].r + _CLEARANCE:
                return False
    return True


def _is_seen(links: list[_Link]) -> bool:
    """Whether the arm is in the image, hardly hidden by itself, and no long link seen end on."""
    azimuth, elevation = np.radians(AZIMUTH), np.radians(ELEVATION)
    forward = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
         np.sin(elevation)]
    )  # fmt: skip
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    camera = np.array(LOOK_AT) - DISTANCE * forward
    arm = links[_UPPER:]
    points = np.concatenate([link.points for link in arm]) - camera  # (n, 3), from the camera
    radii = np.repeat([link.r for link in arm], _POINTS)
    depth, half = points @ forward, np.tan(np.radians(FOV / 2))
    for side in (right, np.cross(right, forward)):
        if (np.abs(points @ side) + radii > _MARGIN * half * depth).any():
            return False
    for i in _LONG:
        along, sight = links[i].q - links[i].p, links[i].points.mean(axis=0) - camera
        sine = np.linalg.norm(np.cross(along, sight))
        if sine < _ASIDE * np.linalg.norm(along) * np.linalg.norm(sight):
            return False
    return _share_in_sight(links, camera) > _IN_SIGHT


def _share_in_sight(links: list[_Link], camera: Vector) -> float:
    """Share of the points along the arm that no link but their own and its neighbors hides."""
    hidden: list[NDArray[np.bool_]] = []
    for i, link in enumerate(links[_UPPER:], start=_UPPER):
        rays = link.points - camera
        distance = np.linalg.norm(rays, axis=1, keepdims=True)
        others = [(j, other) for j, other in enumerate(links) if abs(i - j) > 1]
        centers = np.concatenate([other.points for _, other in others]) - camera
        radii = np.repeat([other.r for _, other in others], _POINTS)
        along = (rays / distance) @ centers.T  # (n, m) depth of the others on each line of sight
        beside = np.sqrt(np.maximum((centers**2).sum(axis=1) - along**2, 0.0))
        hidden.append(((beside < radii) & (along < distance - link.r)).any(axis=1))
    return 1.0 - float(np.mean(hidden))
