"""A scene of the user's own: what must be right before Mitsuba loads it, and what is taken from it.

A scene may name only files in its own folder and the folders below it; see `scene_xml`. Plugins,
which are code, must be Mitsuba's own: one that it has not got it would look for in the folder in
which this process was started, whatever `mitsuba_variant.in_variant` says.
"""

from __future__ import annotations

import math
from os import PathLike
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from fide_tasks import scene_xml

SUFFIXES = (".xml", ".obj", ".ply")


def checked_scene(path: str | PathLike[str]) -> Path:
    """Return the absolute path of a scene file that can be loaded.

    Raises FileNotFoundError if it, or a file that it names, is missing; ValueError if it is of
    another kind than XML, OBJ or PLY, or an XML scene that is malformed, has no sensor or no
    emitter, or names a file outside its folder.
    """
    file = Path(path).expanduser().resolve()
    if file.suffix.lower() not in SUFFIXES:
        raise ValueError(f"scene must be a file of type {', '.join(SUFFIXES)}, not {str(path)!r}")
    if not file.is_file():
        raise FileNotFoundError(f"there is no scene file {str(file)!r}")
    if file.suffix.lower() == ".xml":
        _read(file)
    return file


def load(mi: Any, file: Path) -> tuple[dict[str, Any], float | None]:
    """Load a scene that `checked_scene` has passed; returns its parts and the field of view.

    `mi` is what `mitsuba_variant.in_variant` gives.

    The parts are for `mi.load_dict`. An XML scene gives its shapes and emitters, its first point
    light under the name "light", and the field of view of its sensor in degrees, across the shorter
    side of its film. A mesh gives its one shape, "mesh"; its field of view is None.

    Raises ValueError with Mitsuba's reason if it cannot be loaded, or if nothing is in it, or if it
    names a plugin that Mitsuba has not got.
    """
    try:
        if file.suffix.lower() == ".xml":
            return _from_xml(mi, file)
        return _from_mesh(mi, file), None
    except RuntimeError as error:
        raise ValueError(f"Mitsuba cannot load the scene {str(file)!r}: {error}") from error


def _from_xml(mi: Any, file: Path) -> tuple[dict[str, Any], float]:
    description = _read(file)
    for integrator in description.findall("integrator"):  # a task has its own
        description.remove(integrator)
    _check_plugins(mi, description, file)
    scene = mi.load_string(scene_xml.text(description))
    if not scene.shapes():
        raise ValueError(f"the scene {str(file)!r} has no shape")
    parts = {f"shape_{i}": shape for i, shape in enumerate(scene.shapes())}
    for i, emitter in enumerate(scene.emitters()):
        if mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface):
            continue  # comes with its shape
        is_point = "position" in mi.traverse(emitter)
        parts["light" if is_point and "light" not in parts else f"emitter_{i}"] = emitter
    sensor = scene.sensors()[0]
    params = mi.traverse(sensor)
    if "x_fov" not in params:
        raise ValueError(f"the sensor of the scene {str(file)!r} must be of type 'perspective'")
    width, height = sensor.film().size()
    half = math.tan(math.radians(float(np.ravel(params["x_fov"])[0]) / 2)) * min(1, height / width)
    return parts, math.degrees(2 * math.atan(half))


def _check_plugins(mi: Any, scene: Element, file: Path) -> None:
    own = {plugin.stem for plugin in (Path(mi.__file__).parent / "plugins").iterdir()}
    for element in scene.iter():
        kind = element.get("type")
        if kind is not None and kind not in own:
            raise ValueError(
                f"Mitsuba cannot load the scene {str(file)!r}: it has no {element.tag} of type "
                f"{kind!r}"
            )


def _from_mesh(mi: Any, file: Path) -> dict[str, Any]:
    """A mesh in gray, or in the colors of its vertices."""

    def shape(color: dict[str, Any]) -> Any:
        surface = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": color}}
        kind = file.suffix.lower().removeprefix(".")
        return mi.load_dict({"type": kind, "filename": str(file), "bsdf": surface})

    mesh = shape({"type": "rgb", "value": 0.5})
    if mesh.face_count() == 0:
        raise ValueError(f"the mesh {str(file)!r} has no triangle")
    if "vertex_color" in mi.traverse(mesh):
        mesh = shape({"type": "mesh_attribute", "name": "vertex_color"})
    return {"mesh": mesh}


def _read(file: Path) -> Element:
    """The scene in an XML file; raises as `checked_scene`."""
    scene = scene_xml.read(file)
    for tag, role in (("sensor", "its field of view"), ("emitter", "light")):
        if scene.find(f".//{tag}") is None:
            raise ValueError(
                f"the scene {str(file)!r} has no {tag}: add a <{tag}> element, which gives {role}"
            )
    return scene
