"""Render a scene with the values of a JSON file.

    blender -b SCENE.blend -P render.py -- PARAMETERS.json OUT.png JOB.json
    python render.py SCENE.blend -- PARAMETERS.json OUT.png JOB.json     # where bpy is a module

The job says which property each parameter is, and how large the image is.
"""

import json
import random
import re
import sys
from pathlib import Path

import bpy

PATH = re.compile(r"(?:bpy\.data\.)?(?P<owner>.+)\.(?P<name>\w+)(?:\[(?P<index>\d+)\])?$")


def put(path, value):
    """Set the property of a full data path, such as bpy.data.objects["Lamp"].location[0]."""
    found = PATH.match(path)
    if found is None:
        raise ValueError(f"{path!r} is no full data path: take Copy Full Data Path of the property")
    owner = bpy.data.path_resolve(found["owner"])
    if found["index"] is None:
        setattr(owner, found["name"], value)
    else:
        getattr(owner, found["name"])[int(found["index"])] = value


def main(params, out, job):
    job = json.loads(Path(job).read_text("utf-8"))
    for name, value in json.loads(Path(params).read_text("utf-8")).items():
        put(job["paths"][name], value)
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y = job["size"]
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format, scene.render.filepath = "PNG", out
    scene.cycles.seed = random.randrange(2**31)  # other noise each time
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    if not bpy.app.binary_path:
        bpy.ops.wm.open_mainfile(filepath=sys.argv[1])
    main(*sys.argv[sys.argv.index("--") + 1 :])
