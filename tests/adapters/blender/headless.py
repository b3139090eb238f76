"""Runs inside Blender: install the zip, fit the lamp's place to a picture, and print what it found.

python headless.py ZIP FOLDER FIDE
"""

from __future__ import annotations

import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import bpy

archive, folder, program = sys.argv[1], Path(sys.argv[2]), sys.argv[3]


def make_scene() -> Any:
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples = "CYCLES", 4
    scene.render.resolution_x, scene.render.resolution_y = 64, 48
    bpy.ops.mesh.primitive_uv_sphere_add()
    bpy.ops.object.camera_add(location=(0, -5, 0), rotation=(1.5708, 0, 0))
    scene.camera = bpy.context.object
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "POINT"))
    lamp.data.energy, lamp.location = 800, (2, -3, 1)
    scene.collection.objects.link(lamp)
    return scene


def main() -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)  # which disables add-ons
    bpy.ops.extensions.package_install_files(
        filepath=archive, repo="user_default", enable_on_install=True
    )
    bpy.ops.preferences.addon_enable(module="bl_ext.user_default.fide_fit")
    scene = make_scene()
    scene.render.filepath = str(folder / "target.png")
    bpy.ops.render.render(write_still=True)
    bpy.data.objects["Lamp"].location[0] = -1
    settings = scene.fide
    settings.target, settings.program = scene.render.filepath, program
    settings.size, settings.budget = 32, 16
    one = settings.parameters.add()
    one.path, one.low, one.high = 'bpy.data.objects["Lamp"].location[0]', -4, 4
    assert bpy.ops.fide.fit() == {"FINISHED"}
    addon = import_module("bl_ext.user_default.fide_fit")
    while addon.look(scene.name) is not None:  # Blender itself calls it once a second
        time.sleep(0.2)
    print("status", settings.status)
    print("found", bpy.data.objects["Lamp"].location[0])


if __name__ == "__main__":
    main()
