"""The courtyard: its triangles and their fronts."""

from __future__ import annotations

import numpy as np

from fide_tasks.courtyard import courtyard

# Number of triangles, their area in square meters, and its moments by place and by color.
REFERENCE = [
    58464,
    5754.98624141,
    94504.5538393,
    30238.3394344,
    26783.7832065,
    2785.63415476,
    1750.19527816,
    1091.15383683,
]


def test_it_is_the_same_on_every_machine_and_shows_its_fronts() -> None:
    mesh = courtyard()
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    front = np.cross(b - a, c - a)
    length = np.linalg.norm(front, axis=1, keepdims=True)
    assert length.min() > 1e-4 and mesh.colors.min() >= 0 and mesh.colors.max() <= 1
    color, area = mesh.colors[mesh.faces].mean(axis=1), length / 2
    moments = [*(area * (a + b + c) / 3).sum(0), *(area * color).sum(0)]
    np.testing.assert_allclose([len(mesh.faces), area.sum(), *moments], REFERENCE, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, rtol=1e-6)
    assert np.einsum("fi,fki->fk", front / length, mesh.normals[mesh.faces]).min() > 0.4
