"""Find the lengths of an OpenSCAD part, a link with two eyes, from its drawing in two views.

    python examples/openscad.py          # a short run
    python examples/openscad.py 1000     # the run of the page "Fit a CAD model"

Nine lengths in mm; rules of the space say where a wall must remain.  Each render starts `openscad`,
which needs no display for STL.  Needs OpenSCAD and trimesh; without them it says so and ends.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from numpy.typing import NDArray

from fide_plugins import Float, Space, fit

SOURCE = """
length = 70; big = 40; bore = 22; small = 24; pin = 10; web = 16; slot = 6; fillet = 4; thick = 10;
$fn = 64;
module eye(d) { circle(d = d); translate([length, 0]) children(); }
linear_extrude(thick) difference() {
  offset(-fillet) offset(fillet) {
    eye(big) circle(d = small);
    translate([0, -web / 2]) square([length, web]);
  }
  eye(bore) circle(d = pin);
  hull() {
    translate([big / 2 + slot / 2, 0]) circle(d = slot);
    translate([length - small / 2 - slot / 2, 0]) circle(d = slot);
  }
}
"""
SPACE = Space(
    {
        "length": Float(50, 85, unit="mm"), "big": Float(20, 50, unit="mm"),
        "bore": Float(8, 40, unit="mm"), "small": Float(12, 36, unit="mm"),
        "pin": Float(4, 26, unit="mm"), "web": Float(8, 30, unit="mm"),
        "slot": Float(2, 20, unit="mm"), "fillet": Float(1, 10, unit="mm"),
        "thick": Float(4, 25, unit="mm"),
    },
    constraints={
        "wall of the big eye": "bore + 6 < big",
        "wall of the small eye": "pin + 6 < small",
        "walls of the slot": "slot + 6 < web",
        "web between the eyes": "web < min(big, small)",
        "slot between the eyes": "big / 2 + small / 2 + 2 * slot < length",
    },
)  # fmt: skip
TRUTH = {
    "length": 70.0, "big": 40.0, "bore": 22.0, "small": 24.0, "pin": 10.0, "web": 16.0,
    "slot": 6.0, "fillet": 4.0, "thick": 10.0,
}  # fmt: skip
WIDTH, HEIGHT, FINE = 96, 48, 4  # pixels of a view; each is the mean of FINE x FINE
PIXEL = 1.3  # mm


def view(corners: NDArray[np.float64], middle: tuple[float, float]) -> NDArray[np.uint8]:
    """Triangles (n, 3 corners, 3) seen along -z, (HEIGHT, WIDTH): faces that slope are darker."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    slope = normal[:, 2] / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    order = np.argsort(corners[..., 2].mean(axis=1))  # the nearest is drawn last
    flat = (corners[..., :2] - middle) / PIXEL * (1, -1) + (WIDTH / 2, HEIGHT / 2)
    points = np.rint(16 * (flat * FINE - 0.5)).astype(np.int32)
    image = np.full((HEIGHT * FINE, WIDTH * FINE), 255, np.uint8)
    for face in order[slope[order] > 0]:
        cv2.fillConvexPoly(image, points[face], 30 + 140 * float(slope[face]), shift=4)
    return cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA).astype(np.uint8)


def render(lengths: dict[str, float]) -> list[NDArray[np.uint8]]:
    """The drawing: the part from above and from its side."""
    with TemporaryDirectory() as folder:
        source, part = Path(folder, "part.scad"), Path(folder, "part.stl")
        source.write_text(SOURCE)
        given = [word for name, mm in lengths.items() for word in ("-D", f"{name}={mm:.6f}")]
        command = ["openscad", "-q", "-o", str(part), *given, str(source)]
        subprocess.run(command, check=True, timeout=60)
        corners = import_module("trimesh").load_mesh(part, process=False).triangles
    side = np.stack([corners[..., 0], corners[..., 2], -corners[..., 1]], axis=-1)
    return [view(corners, (40, 0)), view(side, (40, 12))]


def main(budget: int) -> None:
    if shutil.which("openscad") is None or find_spec("trimesh") is None:
        print("no OpenSCAD here: apt-get install openscad; pip install trimesh")
        return
    out = Path(f"runs/openscad-{budget}")
    target = render(TRUTH)
    result = fit(render, target, SPACE, budget=budget, workers=2, out=out, resume=True, seed=0)
    print(result)
    for name, true in TRUTH.items():
        print(f"{name:8} {true:>5}  {result.params[name]:.4g}")
    drawn = np.hstack([np.vstack(target), np.vstack(render(result.params))])
    cv2.imwrite(str(out / "drawing.png"), drawn)
    print(f"look at {out}/drawing.png: the target, the best render")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 120)
