"""Calibrate a simulation from frames of a video: friction, damping and the camera (MuJoCo).

    python examples/mujoco_video.py          # a short run
    python examples/mujoco_video.py 600     # the run of the page "Calibrate MuJoCo from a video"

A box slides over a floor and stops; a pendulum swings ever less.  Seven parameters, six frames.
Without MuJoCo or OpenGL it says so and ends.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fide_plugins import Float, Result, Space, fit

SIDE = 64
TIMES = (0.15, 0.45, 0.75, 1.1, 1.5, 2.0)  # s
SPACE = Space(
    friction=Float(0.05, 1), damping=Float(0.001, 0.1, unit="N m s/rad", log=True),
    push=Float(1, 4, unit="m/s"), azimuth=Float(40, 140, unit="deg"),
    elevation=Float(5, 60, unit="deg"), distance=Float(1.5, 4, unit="m"),
    view=Float(25, 65, unit="deg"),
)  # fmt: skip
TRUTH = {
    "friction": 0.32, "damping": 0.012, "push": 2.6, "azimuth": 75.0, "elevation": 22.0,
    "distance": 2.3, "view": 48.0,
}  # fmt: skip
MODEL = """
<mujoco>
  <option timestep="0.005" cone="elliptic" impratio="10"/>
  <visual><quality offsamples="4"/></visual>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1=".8 .9 1" rgb2=".3 .5 .7"
      width="64" height="384"/>
    <texture name="tiles" type="2d" builtin="checker" rgb1=".75 .72 .66" rgb2=".6 .56 .5"
      width="256" height="256"/>
    <material name="floor" texture="tiles" texrepeat="6 6" specular="0"/>
  </asset>
  <worldbody>
    <light type="directional" castshadow="false" pos="1 -1 3" dir="-.3 .4 -1" diffuse=".7 .7 .7"/>
    <geom name="floor" type="plane" size="2 2 .1" material="floor"/>
    <body name="box" pos="-.9 -.2 .13">
      <freejoint/>
      <geom name="box" type="box" size=".17 .13 .13" rgba=".8 .2 .15 1" mass="1"/>
    </body>
    <geom type="box" size=".03 .03 .5" pos="0 .43 .5" rgba=".4 .4 .4 1"/>
    <body pos="0 .25 .95">
      <joint name="pivot" type="hinge" axis="0 1 0"/>
      <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.6" rgba=".3 .3 .3 1" mass=".05"/>
      <geom type="sphere" size=".12" pos="0 0 -.65" rgba=".15 .35 .8 1" mass=".2"/>
    </body>
  </worldbody>
</mujoco>
"""


class Video:
    """Simulation and OpenGL renderer; they stay in the process that made them."""

    def __init__(self) -> None:
        os.environ.setdefault("MUJOCO_GL", "egl")  # read when MuJoCo is imported
        self.mujoco: Any = import_module("mujoco")
        self.model = self.mujoco.MjModel.from_xml_string(MODEL)
        self.data = self.mujoco.MjData(self.model)
        self.renderer = self.mujoco.Renderer(self.model, SIDE, SIDE)
        self.camera = self.mujoco.MjvCamera()

    def __call__(self, p: dict[str, float]) -> list[NDArray[np.uint8]]:
        """One image (SIDE, SIDE, 3) for each of TIMES."""
        self.camera.azimuth, self.camera.elevation = p["azimuth"], -p["elevation"]
        self.camera.distance = p["distance"]
        self.camera.lookat[:] = 0, 0, 0.4
        self.model.vis.global_.fovy = p["view"]
        for name in ("floor", "box"):  # the larger friction of two that touch counts
            self.model.geom(name).friction[0] = p["friction"]
        self.model.dof_damping[-1] = p["damping"]
        self.mujoco.mj_resetData(self.model, self.data)
        self.data.qvel[0] = p["push"]
        self.data.joint("pivot").qpos[0] = np.radians(70)
        frames = []
        for time in TIMES:
            while self.data.time < time:
                self.mujoco.mj_step(self.model, self.data)
            self.renderer.update_scene(self.data, self.camera)
            frames.append(np.array(self.renderer.render()))
        return frames


def save_picture(rows: dict[str, list[NDArray[np.uint8]]], file: Path) -> None:
    """The frames of each row."""
    figure = Figure(figsize=(8, 1.45 * len(rows)), layout="constrained")
    for axes, (name, frames) in zip(
        figure.subplots(len(rows), len(TIMES)), rows.items(), strict=True
    ):
        axes[0].set_ylabel(name)
        for axis, frame, time in zip(axes, frames, TIMES, strict=True):
            axis.imshow(frame)
            axis.set(xticks=[], yticks=[], title=f"{time} s" if name == "video" else "")
    figure.savefig(file, dpi=110)


def main(budget: int) -> None:
    try:
        render = Video()
    except Exception as error:  # MuJoCo has no class of its own for a machine without OpenGL
        print(f"no MuJoCo here: {error}")
        print("pip install mujoco; apt-get install libegl1 libgl1-mesa-dri")
        return
    rng = np.random.default_rng(0)  # of the camera's noise
    video = [np.clip(f + rng.normal(0, 4, f.shape), 0, 255).astype(np.uint8) for f in render(TRUTH)]
    out = Path(f"runs/mujoco-{budget}")
    how: dict[str, Any] = {"workers": 0, "seed": 0, "resume": True}
    result: Result = fit(render, video, SPACE, budget=budget, out=out, **how)
    print(result)
    for name, true in TRUTH.items():
        print(f"{name:10} {true:>6}  {result.params[name]:.4g}")
    middle = render(SPACE.decode(np.full(SPACE.dim, 0.5)))
    rows = {"video": video, "middle": middle, "found": render(result.params)}
    save_picture(rows, out / "frames.png")
    print(f"look at {out}/frames.png")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 150)
