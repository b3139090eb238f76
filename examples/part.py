"""Find the lengths of a mechanical part from its drawing: a flange, built by trimesh.

    python examples/part.py          # a short run
    python examples/part.py 3000     # the run of the gallery

The drawing has two views, from above and a section through the middle; 12 parameters in mm, one of
them the number of holes.  Needs trimesh and manifold3d; without them it says so and ends.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fide_plugins import Float, Int, Space, fit

SIDE, FINE = 72, 4  # pixels of a view; each is the mean of FINE x FINE
FIELD = 110.0  # mm across a view
SPACE = Space(
    outer=Float(60, 105, unit="mm"), plate=Float(4, 20, unit="mm"),
    hub=Float(25, 55, unit="mm"), height=Float(10, 60, unit="mm"), bore=Float(8, 24, unit="mm"),
    holes=Int(3, 10), circle=Float(40, 90, unit="mm"), hole=Float(3, 12, unit="mm"),
    counterbore=Float(8, 18, unit="mm"), counterbore_depth=Float(0, 10, unit="mm"),
    key_width=Float(2, 10, unit="mm"), key_depth=Float(0, 6, unit="mm"),
)  # fmt: skip
TRUTH: dict[str, Any] = {
    "outer": 90.0, "plate": 12.0, "hub": 42.0, "height": 38.0, "bore": 20.0, "holes": 6,
    "circle": 66.0, "hole": 7.0, "counterbore": 12.0, "counterbore_depth": 5.0, "key_width": 6.0,
    "key_depth": 3.0,
}  # fmt: skip


def flange(p: dict[str, Any]) -> Any:
    """The part as a mesh of trimesh, in mm: its axis is z, its lower side z = 0."""
    trimesh: Any = import_module("trimesh")

    def disk(diameter: float, low: float, high: float, x: float = 0, y: float = 0) -> Any:
        made = trimesh.creation.cylinder(diameter / 2, high - low, sections=64)
        return made.apply_translation((x, y, (low + high) / 2))

    solid = [disk(p["outer"], 0, p["plate"]), disk(p["hub"], 0, p["height"])]
    key = trimesh.creation.box((p["bore"] / 2 + p["key_depth"], p["key_width"], 200))
    key.apply_translation((key.extents[0] / 2, 0, 0))
    removed = [disk(p["bore"], -1, 100), key]
    for angle in 2 * np.pi * np.arange(p["holes"]) / p["holes"]:
        x, y = p["circle"] / 2 * np.cos(angle), p["circle"] / 2 * np.sin(angle)
        removed.append(disk(p["hole"], -1, 100, x, y))
        removed.append(disk(p["counterbore"], p["plate"] - p["counterbore_depth"], 100, x, y))
    whole = trimesh.boolean.union(solid, engine="manifold")
    return trimesh.boolean.difference([whole, *removed], engine="manifold")


def from_above(mesh: Any) -> NDArray[np.uint8]:
    """The plan, (SIDE, SIDE): on white paper, the higher a face, the darker."""
    faces = mesh.triangles[mesh.face_normals[:, 2] > 0.5]  # (n, 3 corners, 3)
    faces = faces[np.argsort(faces[..., 2].mean(axis=1))]  # the highest is drawn last
    corners = np.rint(16 * ((faces[..., :2] / FIELD + 0.5) * SIDE * FINE - 0.5)).astype(np.int32)
    image = np.full((SIDE * FINE, SIDE * FINE), 255, np.uint8)
    for triangle, z in zip(corners, faces[..., 2].mean(axis=1), strict=True):
        cv2.fillConvexPoly(image, triangle, 200 - 2.8 * float(z), shift=4)
    return cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_AREA).astype(np.uint8)


def section(mesh: Any) -> NDArray[np.uint8]:
    """The section y = 0, (SIDE, SIDE): x to the right, z up; material is dark."""
    cut = import_module("trimesh").intersections.mesh_plane(mesh, (0, 1, 0), (0, 1e-3, 0))
    x, z = np.moveaxis(cut[..., ::2], -1, 0)  # (n, 2 ends) of each line around the material
    grid = (np.arange(SIDE * FINE) + 0.5) / (SIDE * FINE)
    across, up = FIELD * (grid - 0.5), FIELD * (0.75 - grid)
    inside = np.zeros((len(up), len(across)), bool)
    for (x0, x1), (z0, z1) in zip(x, z, strict=True):  # a point is inside after an odd number
        rows = (up > min(z0, z1)) & (up <= max(z0, z1))  # of lines to its left
        if rows.any():
            at = x0 + (up[rows] - z0) / (z1 - z0) * (x1 - x0)
            inside[rows] ^= across > at[:, None]
    image = np.where(inside, 60, 255).astype(np.uint8)
    return cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_AREA).astype(np.uint8)


def render(p: dict[str, Any]) -> list[NDArray[np.uint8]]:
    """The drawing: two views."""
    mesh = flange(p)
    return [from_above(mesh), section(mesh)]


def save_picture(result: Any, file: Path) -> None:
    """Both views of the target and of the best render, and the loss."""
    figure = Figure(figsize=(8, 5.6), layout="constrained")
    above = figure.subplot_mosaic("0123\nLLLL")
    drawn = {"target": render(TRUTH), "best render": render(result.params)}
    titled = [(name, view) for name, views in drawn.items() for view in views]
    for number, (name, view) in enumerate(titled):
        axis = above[str(number)]
        axis.imshow(view, cmap="gray", vmin=0, vmax=255)
        axis.set(title=f"{name}, {'section' if number % 2 else 'plan'}", xticks=[], yticks=[])
    above["L"].semilogy(result.curve[:, 0], result.curve[:, 1])
    above["L"].set(xlabel="renders", ylabel="best loss (mse)")
    figure.savefig(file, dpi=120)


def main(budget: int) -> None:
    if find_spec("trimesh") is None or find_spec("manifold3d") is None:
        print("no mesh here: pip install trimesh manifold3d")
        return
    out = Path(f"runs/part-{budget}")
    result = fit(
        render, render(TRUTH), SPACE, budget=budget, workers=2, out=out, resume=True, seed=0
    )
    print(result)
    for name, true in TRUTH.items():
        print(f"{name:17} {true:>6}  {result.params[name]:.4g}")
    save_picture(result, out / "drawing.png")
    print(f"look at {out}/drawing.png")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
