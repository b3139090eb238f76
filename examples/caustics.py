"""Find a ball of colored glass, what glass it is, and the lamp, from a caustic (Mitsuba).

    python examples/caustics.py          # a short run
    python examples/caustics.py 2000     # the run of the gallery, with its film

Twelve parameters.  Path tracing is noisy: 32 samples a pixel, another seed for each render.
Without Mitsuba it says so and ends.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from fide_plugins import Float, Space, fit
from fide_plugins.fitting.callbacks import Event
from fide_tasks import mitsuba_variant

SIDE, SAMPLES = 64, 32
SPACE = Space(
    x=Float(-0.8, 0.8, unit="m"), y=Float(-0.8, 0.8, unit="m"),
    radius=Float(0.2, 0.5, unit="m"), gap=Float(0, 0.5, unit="m"),
    index=Float(1.2, 1.9), roughness=Float(0.02, 0.4),
    red=Float(0, 1), green=Float(0, 1), blue=Float(0, 1),
    lamp_x=Float(-1.5, 1.5, unit="m"), lamp_y=Float(-1.5, 1.5, unit="m"),
    radiance=Float(5, 40, unit="W/(m2 sr)", log=True),
)  # fmt: skip
TRUTH = {
    "x": -0.15, "y": 0.1, "radius": 0.4, "gap": 0.2, "index": 1.5, "roughness": 0.05,
    "red": 0.95, "green": 0.6, "blue": 0.15, "lamp_x": 0.9, "lamp_y": 0.4, "radiance": 14.0,
}  # fmt: skip
WIDTH = 0.4  # radius of the lamp, m; the larger it is, the less noise its caustic has


class Glass:
    """Ball, floor, lamp and camera; the scene stays in the process that made it."""

    def __init__(self) -> None:
        variant = mitsuba_variant.choose("auto")  # before the import, since it looks for LLVM
        self.mi: Any = import_module("mitsuba")
        self.mi.set_variant(variant)
        self.scene = self.mi.load_dict(self._description())
        self.params = self.mi.traverse(self.scene)
        self.rng = np.random.default_rng(0)  # of the noise

    def _description(self) -> dict[str, Any]:
        """The scene, in meters; z is up."""
        camera = self.mi.ScalarTransform4f().look_at((0, -3.2, 2.4), (0, 0, 0.15), (0, 0, 1))
        film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}}
        paper = {"type": "rgb", "value": (0.7, 0.68, 0.65)}
        glass = {"type": "principled", "spec_trans": 1.0, "eta": 1.5, "roughness": 0.1}
        glass["base_color"] = {"type": "rgb", "value": (1, 1, 1)}
        return {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 8},
            "sensor": {"type": "perspective", "fov": 36, "to_world": camera, "film": film},
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": (0.05, 0.07, 0.1)}},
            "floor": {
                "type": "rectangle",
                "to_world": self.mi.ScalarTransform4f().scale(6),
                "bsdf": {"type": "diffuse", "reflectance": paper},
            },
            "ball": {"type": "sphere", "bsdf": glass},
            "lamp": {"type": "sphere", "emitter": {"type": "area", "radiance": 14.0}},
        }

    def __call__(self, p: dict[str, float], samples: int = SAMPLES) -> NDArray[np.uint8]:
        """Image (SIDE, SIDE, 3), with other noise each time."""
        place, shift = self.mi.Transform4f, self.mi.Point3f
        ball = shift(p["x"], p["y"], p["radius"] + p["gap"])
        self.params["ball.to_world"] = place().translate(ball).scale(p["radius"])
        lamp = shift(p["lamp_x"], p["lamp_y"], 2.5)
        self.params["lamp.to_world"] = place().translate(lamp).scale(WIDTH)
        glass = {"eta": p["index"], "roughness.value": p["roughness"]}
        glass["base_color.value"] = self.mi.Color3f(p["red"], p["green"], p["blue"])
        for name, value in glass.items():
            self.params[f"ball.bsdf.{name}"] = value
        self.params["lamp.emitter.radiance.value"] = p["radiance"]
        self.params.update()
        seed = int(self.rng.integers(2**31))
        image = self.mi.render(self.scene, spp=samples, seed=seed)
        return np.array(self.mi.util.convert_to_bitmap(image))


class Film:
    """Callback that keeps the best image whenever the number of renders has grown by a fifth.

    That of shader.py with other numbers: each example is one file that runs by itself.
    """

    def __init__(self, target: NDArray[np.uint8]) -> None:
        self.target, self.frames, self.next = target, list[Image.Image](), 1.0
        self.best = target

    def on_evaluation(self, event: Event) -> None:
        if event.loss == event.best_loss:
            self.best = np.rint(255 * np.asarray(event.image)).astype(np.uint8)
        if event.evaluation + 1 >= self.next:
            self.next *= 1.2
            pair = np.concatenate([self.target, self.best], axis=1)
            self.frames.append(Image.fromarray(pair).resize((6 * SIDE, 3 * SIDE)))

    def save(self, path: Path) -> None:
        if not self.frames:  # the run was there already
            return
        first, *others = self.frames
        times = [100] * len(others) + [2000]  # ms
        first.save(path, save_all=True, append_images=others, duration=times, loop=0, quality=70)


def main(budget: int) -> None:
    if find_spec("mitsuba") is None:
        print("no Mitsuba here: pip install mitsuba")
        return
    render = Glass()
    target, out = render(TRUTH, samples=1024), Path(f"runs/caustics-{budget}")
    film = Film(target)
    # "accurate": so the result in the gallery was made; the default was not tried.
    how: dict[str, Any] = {"workers": 0, "seed": 0, "preset": "accurate", "resume": True}
    result = fit(render, target, SPACE, budget=budget, out=out, callbacks=[film], **how)
    print(result)
    recommended = SPACE.decode(result.optimizer.recommend())  # the best render was partly lucky
    for name, true in TRUTH.items():
        print(f"{name:10} {true:>6}  {recommended[name]:.3g}")
    film.save(out / "film.webp")
    print(f"look at {out}/summary.png and {out}/film.webp")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 120)
