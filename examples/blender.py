"""Find a procedural material and a lamp in Blender (the module bpy, Cycles).

    python examples/blender.py          # a short run
    python examples/blender.py 1000     # the run of the gallery

A ball of veined stone under one lamp, eleven parameters.  Path tracing is noisy: 16 samples a
pixel, another seed for each render.  Without bpy it says so and ends.
"""

from __future__ import annotations

import os
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from importlib import import_module
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from fide_plugins import Float, Space, fit, images

SIDE, SAMPLES = 72, 16
SPACE = Space(
    scale=Float(1, 8), distortion=Float(0, 3), roughness=Float(0.05, 1),
    dark_r=Float(0, 1), dark_g=Float(0, 1), dark_b=Float(0, 1),
    light_r=Float(0, 1), light_g=Float(0, 1), light_b=Float(0, 1),
    azimuth=Float(-180, 180, unit="deg", periodic=True), height=Float(10, 80, unit="deg"),
)  # fmt: skip
TRUTH = {
    "scale": 3.0, "distortion": 1.0, "roughness": 0.3,
    "dark_r": 0.05, "dark_g": 0.15, "dark_b": 0.3,
    "light_r": 0.9, "light_g": 0.75, "light_b": 0.5, "azimuth": -50.0, "height": 40.0,
}  # fmt: skip


def scene() -> Any:
    """Blender's scene, made once in each process: ball, floor, material, lamp, camera."""
    bpy: Any = import_module("bpy")  # in here: the process that starts workers must not import it
    if "fide" in bpy.data.materials:
        return bpy
    bpy.ops.wm.read_factory_settings(use_empty=True)
    settings = bpy.context.scene
    settings.render.engine, settings.cycles.device = "CYCLES", "CPU"
    settings.cycles.samples, settings.cycles.max_bounces = SAMPLES, 3
    settings.render.threads_mode, settings.render.threads = "FIXED", 1
    settings.render.resolution_x = settings.render.resolution_y = SIDE
    settings.view_settings.view_transform = "Standard"
    settings.world = bpy.data.worlds.new("fide")
    bpy.ops.mesh.primitive_plane_add(size=20, location=(0, 0, -1))
    bpy.ops.mesh.primitive_uv_sphere_add(segments=48, ring_count=24)
    bpy.ops.object.shade_smooth()
    bpy.context.object.data.materials.append(material(bpy))
    bpy.ops.object.camera_add(location=(0, -4.2, 1.2), rotation=(np.radians(75), 0, 0))
    settings.camera = bpy.context.object
    lamp = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "SUN"))
    lamp.data.energy, lamp.data.angle = 4.0, 0.1
    settings.collection.objects.link(lamp)
    return bpy


def material(bpy: Any) -> Any:
    """Two colors, mixed by a distorted noise."""
    made = bpy.data.materials.new("fide")
    made.use_nodes = True
    tree = made.node_tree
    noise, ramp = tree.nodes.new("ShaderNodeTexNoise"), tree.nodes.new("ShaderNodeValToRGB")
    place = tree.nodes.new("ShaderNodeTexCoord")
    noise.name, ramp.name = "noise", "ramp"
    ramp.color_ramp.elements[0].position, ramp.color_ramp.elements[1].position = 0.4, 0.6
    tree.links.new(place.outputs["Object"], noise.inputs["Vector"])
    tree.links.new(noise.outputs["Fac"], ramp.inputs["Fac"])
    tree.links.new(ramp.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    return made


def render(p: dict[str, Any]) -> NDArray[np.float32]:
    """Image (SIDE, SIDE, 3)."""
    bpy = scene()
    nodes = bpy.data.materials["fide"].node_tree.nodes
    nodes["noise"].inputs["Scale"].default_value = p["scale"]
    nodes["noise"].inputs["Distortion"].default_value = p["distortion"]
    nodes["Principled BSDF"].inputs["Roughness"].default_value = p["roughness"]
    for name, end in zip(("dark", "light"), nodes["ramp"].color_ramp.elements, strict=True):
        end.color = (p[f"{name}_r"], p[f"{name}_g"], p[f"{name}_b"], 1)
    tilt, turn = np.radians(90 - p["height"]), np.radians(p["azimuth"])
    bpy.data.objects["lamp"].rotation_euler = (tilt, 0, turn)
    settings = bpy.context.scene
    settings.cycles.seed = int(np.random.default_rng().integers(2**31 - 1))
    with tempfile.TemporaryDirectory() as folder:
        settings.render.filepath = os.path.join(folder, "image.png")
        bpy.ops.render.render(write_still=True)
        return images.load(settings.render.filepath)


def write_target(file: Path) -> None:
    """Mean of 16 renders, with little noise."""
    mean = np.mean([render(TRUTH) for _ in range(16)], axis=0)
    Image.fromarray(np.rint(255 * mean).astype(np.uint8)).save(file)


def main(budget: int) -> None:
    if find_spec("bpy") is None:
        print("no Blender here: pip install bpy==5.0.1")
        return
    picture, out = Path("runs/blender-target.png"), f"runs/blender-{budget}"
    if not picture.exists():
        picture.parent.mkdir(exist_ok=True)
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            pool.submit(write_target, picture).result()
    # "accurate": so the result in the gallery was made; the default was not tried.
    how: dict[str, Any] = {"workers": 2, "seed": 0, "preset": "accurate", "resume": True}
    result = fit(render, picture, SPACE, budget=budget, out=out, **how)
    print(result)
    for name, true in TRUTH.items():
        print(f"{name:11} {true:>6}  {result.params[name]:.3g}")
    print(f"look at {out}/summary.png")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 60)
