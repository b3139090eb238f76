"""Where was the camera, and where the lamp?  A scene of MuJoCo, seen once.

    python examples/camera.py          # a short run
    python examples/camera.py 3000     # the run of the gallery

Eight parameters in degrees and meters.  Without MuJoCo or OpenGL it says so and ends.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fide_plugins import Float, Space, fit

SIDE = 96
SPACE = Space(
    azimuth=Float(0, 360, unit="deg", periodic=True), elevation=Float(10, 80, unit="deg"),
    distance=Float(1.5, 5, unit="m"), view=Float(20, 70, unit="deg"),
    look_x=Float(-0.5, 0.5, unit="m"), look_y=Float(-0.5, 0.5, unit="m"),
    lamp=Float(0, 360, unit="deg", periodic=True), lamp_height=Float(20, 80, unit="deg"),
)  # fmt: skip
TRUTH = {
    "azimuth": 205.0, "elevation": 32.0, "distance": 2.6, "view": 45.0,
    "look_x": 0.1, "look_y": -0.05, "lamp": 310.0, "lamp_height": 42.0,
}  # fmt: skip
MODEL = """
<mujoco>
  <visual>
    <headlight ambient=".3 .3 .3" diffuse="0 0 0" specular="0 0 0"/>
    <quality shadowsize="1024" offsamples="4"/>
  </visual>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1=".8 .9 1" rgb2=".3 .5 .7"
      width="64" height="384"/>
    <texture name="tiles" type="2d" builtin="checker" rgb1=".75 .72 .66" rgb2=".5 .46 .4"
      width="256" height="256"/>
    <material name="floor" texture="tiles" texrepeat="4 4" specular="0"/>
  </asset>
  <worldbody>
    <light name="lamp" type="directional" diffuse=".8 .8 .75" castshadow="true"/>
    <geom type="plane" size="1.5 1.5 .1" material="floor"/>
    <geom type="box" size=".18 .12 .2" pos=".35 .3 .2" euler="0 0 25" rgba=".8 .2 .15 1"/>
    <geom type="cylinder" size=".12 .3" pos="-.4 .25 .3" rgba=".15 .55 .25 1"/>
    <geom type="sphere" size=".2" pos="-.2 -.4 .2" rgba=".2 .35 .8 1"/>
    <geom type="capsule" size=".07 .25" pos=".45 -.35 .07" euler="90 0 40" rgba=".9 .7 .1 1"/>
  </worldbody>
</mujoco>
"""


class Photographer:
    """MuJoCo's OpenGL renderer; it stays in the process that made it."""

    def __init__(self) -> None:
        os.environ.setdefault("MUJOCO_GL", "egl")  # read when MuJoCo is imported
        self.mujoco: Any = import_module("mujoco")
        self.model = self.mujoco.MjModel.from_xml_string(MODEL)
        self.data = self.mujoco.MjData(self.model)
        self.renderer = self.mujoco.Renderer(self.model, SIDE, SIDE)
        self.camera = self.mujoco.MjvCamera()

    def __call__(self, p: dict[str, float]) -> NDArray[np.uint8]:
        """Image (SIDE, SIDE, 3)."""
        self.camera.azimuth, self.camera.elevation = p["azimuth"], -p["elevation"]
        self.camera.distance = p["distance"]
        self.camera.lookat[:] = p["look_x"], p["look_y"], 0.2
        self.model.vis.global_.fovy = p["view"]
        turn, height = np.radians(p["lamp"]), np.radians(p["lamp_height"])
        towards = np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)
        self.model.light("lamp").dir[:] = -np.array(towards)
        self.model.light("lamp").pos[:] = 3 * np.array(towards)
        self.mujoco.mj_forward(self.model, self.data)
        self.renderer.update_scene(self.data, self.camera)
        return np.array(self.renderer.render())


def main(budget: int) -> None:
    try:
        render = Photographer()
    except Exception as error:  # MuJoCo has no class of its own for a machine without OpenGL
        print(f"no MuJoCo here: {error}")
        print("pip install mujoco; apt-get install libegl1 libgl1-mesa-dri")
        return
    out = f"runs/camera-{budget}"
    how: dict[str, Any] = {"workers": 0, "seed": 0, "out": out, "resume": True}
    result = fit(render, render(TRUTH), SPACE, budget=budget, **how)
    print(result)
    for name, true in TRUTH.items():
        print(f"{name:11} {true:>6}  {result.params[name]:.4g}")
    print(f"look at {out}/summary.png")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 300)
