"""The Franka Emika Panda: joint limits and forward kinematics in closed form.

Notation: q [..., 7] joint angles in rad; T_i [..., 4, 4] pose of frame i in the base, lengths in m.
In Craig's convention of Denavit and Hartenberg, frame i is fixed to link i, and

    T_i = T_(i-1) Rx(alpha_(i-1)) Dx(a_(i-1)) Rz(q_i) Dz(d_i)

Source of all numbers: Franka Emika, "Robot and interface specifications",
https://frankaemika.github.io/docs/control_parameters.html (limits and parameters of the Panda).
"""

from __future__ import annotations

import math

import numpy as np

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
