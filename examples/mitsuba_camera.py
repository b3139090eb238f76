"""Where was the camera?  From one picture, or from a silhouette alone (Mitsuba).

    python examples/mitsuba_camera.py          # a short run
    python examples/mitsuba_camera.py 400     # the run of the page "Fit a Mitsuba scene"

Seven parameters: place, direction, roll and field of view, which Mitsuba does not differentiate.
Without Mitsuba it says so and ends.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fide_plugins import Float, Result, Space, fit
from fide_tasks import mitsuba_variant

SIDE, SAMPLES = 64, 64
SPACE = Space(
    azimuth=Float(0, 360, unit="deg", periodic=True), elevation=Float(5, 70, unit="deg"),
    distance=Float(3, 7, unit="m"), view=Float(20, 60, unit="deg"), roll=Float(-30, 30, unit="deg"),
    look_x=Float(-0.6, 0.6, unit="m"), look_y=Float(-0.6, 0.6, unit="m"),
)  # fmt: skip
TRUTH = {
    "azimuth": 240.0, "elevation": 28.0, "distance": 4.6, "view": 36.0, "roll": 8.0,
    "look_x": 0.2, "look_y": -0.1,
}  # fmt: skip
THINGS = {  # (shape, place in m, size in m, color)
    "house": ("cube", (0.6, 0.2, 0.45), (0.45, 0.35, 0.45), (0.75, 0.3, 0.2)),
    "wall": ("cube", (-0.5, 0.7, 0.2), (0.7, 0.1, 0.2), (0.8, 0.75, 0.6)),
    "ball": ("sphere", (-0.5, -0.4, 0.4), (0.4, 0.4, 0.4), (0.2, 0.4, 0.75)),
    "post": ("cube", (0.4, -0.9, 0.6), (0.1, 0.1, 0.6), (0.2, 0.55, 0.3)),
}


class Photographer:
    """The scene, in meters, z up; it stays in the process that made it."""

    def __init__(self) -> None:
        variant = mitsuba_variant.choose("auto")  # before the import, since it looks for LLVM
        self.mi: Any = import_module("mitsuba")
        self.mi.set_variant(variant)
        scene: dict[str, Any] = {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "sensor": self.camera(SIDE),
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": (0.4, 0.5, 0.65)}},
            "sun": {"type": "directional", "direction": (-0.5, 0.6, -1), "irradiance": 1.5},
            "floor": self.thing("rectangle", (0, 0, 0), (20, 20, 1), (0.45, 0.43, 0.4)),
        }
        scene |= {name: self.thing(*how) for name, how in THINGS.items()}
        self.scene = self.mi.load_dict(scene)
        self.params = self.mi.traverse(self.scene)
        self.rng = np.random.default_rng(0)  # of the noise
        del scene["floor"]
        plain = {"integrator": {"type": "depth"}, "sensor": self.camera(4 * SIDE)}
        self.alone = self.mi.load_dict(scene | plain)
        self.params_alone = self.mi.traverse(self.alone)

    def camera(self, side: int) -> dict[str, Any]:
        film = {"type": "hdrfilm", "width": side, "height": side, "rfilter": {"type": "box"}}
        return {"type": "perspective", "film": film}

    def thing(self, shape: str, place: Any, size: Any, color: Any) -> dict[str, Any]:
        to_world = self.mi.ScalarTransform4f().translate(place).scale(size)
        bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": color}}
        return {"type": shape, "to_world": to_world, "bsdf": bsdf}

    def aim(self, params: Any, p: dict[str, float]) -> None:
        """Put the camera where the parameters say."""
        a, e = np.radians(p["azimuth"]), np.radians(p["elevation"])
        away = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        goal = np.array([p["look_x"], p["look_y"], 0.4])
        point = self.mi.Point3f
        start, end = (goal + p["distance"] * away).tolist(), goal.tolist()
        look = self.mi.Transform4f().look_at(point(*start), point(*end), point(0, 0, 1))
        params["sensor.to_world"] = look.rotate(point(0, 0, 1), p["roll"])
        params["sensor.x_fov"] = p["view"]
        params.update()

    def photo(self, p: dict[str, float]) -> NDArray[np.uint8]:
        """Image (SIDE, SIDE, 3), with other noise each time."""
        self.aim(self.params, p)
        seed = int(self.rng.integers(2**31))
        image = self.mi.render(self.scene, spp=SAMPLES, seed=seed)
        return np.array(self.mi.util.convert_to_bitmap(image))

    def silhouette(self, p: dict[str, float]) -> NDArray[np.float32]:
        """Share of each pixel that the things cover, (SIDE, SIDE): their rays have a depth."""
        self.aim(self.params_alone, p)
        depth = np.array(self.mi.render(self.alone, spp=1, seed=0))[..., 0]
        covered = np.asarray(depth > 0, np.float32).reshape(SIDE, 4, SIDE, 4)
        return np.asarray(covered.mean(axis=(1, 3)), np.float32)


class Fit(NamedTuple):
    name: str
    render: Any
    target: NDArray[Any]
    result: Result


def save_picture(found: list[Fit], file: Path) -> None:
    """Target, where the search begins, and the best render, of each fit."""
    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    middle = SPACE.decode(np.full(SPACE.dim, 0.5))
    for row, one in zip(figure.subplots(2, 3), found, strict=True):
        titles = f"{one.name}: target", "middle of the ranges", "found"
        images = one.target, one.render(middle), one.render(one.result.params)
        for axis, title, image in zip(row, titles, images, strict=True):
            axis.imshow(image, cmap="gray")
            axis.set(title=title, xticks=[], yticks=[])
    figure.savefig(file, dpi=110)


def main(budget: int) -> None:
    if find_spec("mitsuba") is None:
        print("no Mitsuba here: pip install mitsuba")
        return
    camera = Photographer()
    how: dict[str, Any] = {"budget": budget, "workers": 0, "seed": 0, "resume": True}
    found: list[Fit] = []
    for name, render, target in (
        ("photo", camera.photo, camera.photo(TRUTH)),
        ("silhouette", camera.silhouette, camera.silhouette(TRUTH)),
    ):
        result = fit(render, target, SPACE, out=f"runs/mitsuba-{name}-{budget}", **how)
        print(name, result)
        found.append(Fit(name, render, target, result))
    for name, true in TRUTH.items():
        values = "  ".join(f"{one.result.params[name]:8.4g}" for one in found)
        print(f"{name:10} {true:>6}  {values}")
    save_picture(found, Path("runs/mitsuba_camera.png"))
    print("look at runs/mitsuba_camera.png")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
