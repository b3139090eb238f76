"""Add-on for Blender: properties of a scene are fitted to a picture by `fide`, in the background.

Blender stays free meanwhile: `fide fit` renders a copy of the scene in other Blender processes.
Needs the program `fide` (its own Python, outside of Blender).
"""

import json
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

import bpy
from bpy.props import (
    CollectionProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from .render import PATH, put

RUNS = {}  # folder and process of the fit of each scene, by its name


class Parameter(bpy.types.PropertyGroup):
    path: StringProperty(name="Path", description="Full data path of the property")
    low: FloatProperty(name="Low", default=0.0)
    high: FloatProperty(name="High", default=1.0)


class Settings(bpy.types.PropertyGroup):
    target: StringProperty(name="Picture", subtype="FILE_PATH")
    program: StringProperty(
        name="Program", default="fide", description="The command fide, or its path"
    )
    size: IntProperty(name="Size", default=96, min=16, description="Pixels of the longer side")
    budget: IntProperty(name="Renders", default=1000, min=1)
    workers: IntProperty(name="Workers", default=2, min=1)
    status: StringProperty(name="Status")
    parameters: CollectionProperty(type=Parameter)


def size_of(target, longest):
    """Width and height of the target, made smaller as `fide fit --size` does."""
    image = bpy.data.images.load(target)
    width, height = image.size
    bpy.data.images.remove(image)
    scale = min(1, longest / max(width, height))
    return [max(1, round(width * scale)), max(1, round(height * scale))]


def write_job(scene, folder):
    """Write scene, space and job; returns the command line of the fit."""
    settings = scene.fide
    target = bpy.path.abspath(settings.target)
    paths = {f"p{i}": one.path for i, one in enumerate(settings.parameters)}
    ranges = [(one.low, one.high) for one in settings.parameters]
    tables = (
        f'[p{i}]\ntype = "float"\nlow = {low!r}\nhigh = {high!r}\n'
        for i, (low, high) in enumerate(ranges)
    )
    (folder / "space.toml").write_text("\n".join(tables), "utf-8")
    job = {"paths": paths, "size": size_of(target, settings.size)}
    (folder / "job.json").write_text(json.dumps(job), "utf-8")
    blend, script = str(folder / "scene.blend"), str(Path(__file__).with_name("render.py"))
    bpy.ops.wm.save_as_mainfile(filepath=blend, copy=True)
    if bpy.app.binary_path:
        words = [bpy.app.binary_path, "-b", blend, "-P", script]
    else:
        words = [sys.executable, script, blend]
    fixed = (word.replace("{", "{{").replace("}", "}}") for word in words)
    render = f"{shlex.join(fixed)} -- {{params}} {{out}} {shlex.quote(str(folder / 'job.json'))}"
    options = {"--command": render, "--space": folder / "space.toml", "--out": folder / "run"}
    options |= {"--size": settings.size, "--budget": settings.budget, "--timeout": "10m"}
    options |= {"--workers": settings.workers}
    listed = [str(word) for pair in options.items() for word in pair]
    return [*shlex.split(settings.program), "fit", target, *listed]


class FIDE_OT_add(bpy.types.Operator):
    """Add the property whose full data path was copied (right click: Copy Full Data Path)"""

    bl_idname, bl_label = "fide.add", "Add Copied Property"

    def execute(self, context):
        path = context.window_manager.clipboard.strip()
        if PATH.match(path) is None:
            self.report({"ERROR"}, "First right-click a property: Copy Full Data Path")
            return {"CANCELLED"}
        context.scene.fide.parameters.add().path = path
        return {"FINISHED"}


class FIDE_OT_remove(bpy.types.Operator):
    """Remove this property"""

    bl_idname, bl_label = "fide.remove", "Remove"
    index: IntProperty()

    def execute(self, context):
        context.scene.fide.parameters.remove(self.index)
        return {"FINISHED"}


class FIDE_OT_fit(bpy.types.Operator):
    """Start the fit; Blender stays free meanwhile"""

    bl_idname, bl_label = "fide.fit", "Fit"

    def execute(self, context):
        scene = context.scene
        if scene.name in RUNS or not scene.fide.parameters or not scene.fide.target:
            self.report({"ERROR"}, "Choose a picture and properties; one fit at a time")
            return {"CANCELLED"}
        folder = Path(tempfile.mkdtemp(prefix="fide-"))
        try:
            command = write_job(scene, folder)
            with open(folder / "log.txt", "w") as log:
                process = subprocess.Popen(command, stdout=log, stderr=log)
        except (OSError, RuntimeError) as error:  # no program, no picture
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        RUNS[scene.name] = folder, process
        scene.fide.status = f"Running in {folder}"
        bpy.app.timers.register(lambda: look(scene.name), first_interval=1.0)
        return {"FINISHED"}


class FIDE_OT_stop(bpy.types.Operator):
    """End the fit, and take the values found so far"""

    bl_idname, bl_label = "fide.stop", "Stop"

    def execute(self, context):
        if context.scene.name in RUNS:
            RUNS[context.scene.name][1].terminate()  # it saves its run
        return {"FINISHED"}


def look(name):
    """Wait for the end of a fit, and put what it found into the scene; seconds to wait, or None."""
    folder, process = RUNS[name]
    if process.poll() is None:
        return 1.0
    del RUNS[name]
    scene = bpy.data.scenes[name]
    try:
        totals = json.loads((folder / "run" / "run.json").read_text("utf-8"))["totals"]
        found = totals["params"]
    except (OSError, KeyError, ValueError):
        scene.fide.status = f"Failed: see {folder / 'log.txt'}"
        return None
    for i, parameter in enumerate(scene.fide.parameters):
        put(parameter.path, found[f"p{i}"])
    scene.fide.status = f"Loss {totals['best_loss']:.3g}; pictures in {folder / 'run'}"
    return None


class FIDE_PT_panel(bpy.types.Panel):
    bl_label, bl_space_type, bl_region_type = "FIDE", "PROPERTIES", "WINDOW"
    bl_context = "render"

    def draw(self, context):
        settings = context.scene.fide
        for name in ("target", "size", "budget", "workers", "program"):
            self.layout.prop(settings, name)
        for index, parameter in enumerate(settings.parameters):
            self.layout.prop(parameter, "path", text="")
            row = self.layout.row(align=True)
            row.prop(parameter, "low")
            row.prop(parameter, "high")
            row.operator("fide.remove", text="", icon="X").index = index
        self.layout.operator("fide.add")
        running = context.scene.name in RUNS
        self.layout.operator("fide.stop" if running else "fide.fit")
        self.layout.label(text=settings.status)


CLASSES = (
    Parameter, Settings, FIDE_OT_add, FIDE_OT_remove, FIDE_OT_fit, FIDE_OT_stop, FIDE_PT_panel,
)  # fmt: skip


def register():
    for one in CLASSES:
        bpy.utils.register_class(one)
    bpy.types.Scene.fide = PointerProperty(type=Settings)


def unregister():
    for _, process in RUNS.values():
        process.terminate()
    del bpy.types.Scene.fide
    for one in reversed(CLASSES):
        bpy.utils.unregister_class(one)
