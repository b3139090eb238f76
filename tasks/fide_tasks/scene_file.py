"""A scene of the user's own: what must be right before Mitsuba loads it, and what is taken from it.

An XML scene can name any file on the machine, and Mitsuba opens what it names. So a scene may name
only files in its own folder and the folders below it.
"""

from __future__ import annotations

from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

SUFFIXES = (".xml", ".obj", ".ply")
_FILE_NAMES = {"filename", "fn", "file"}  # of parameters that name a file


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
        _check_xml(file)
    return file


def load(mi: Any, file: Path) -> tuple[dict[str, Any], float | None]:
    """Load a scene that `checked_scene` has passed; returns its parts and the field of view.

    The parts are for `mi.load_dict`. An XML scene gives its shapes and emitters, its first point
    light under the name "light", and the horizontal field of view of its sensor in degrees. A mesh
    gives its one shape, "mesh"; its field of view is None.

    Raises ValueError with Mitsuba's reason if it cannot be loaded, or if nothing is in it.
    """
    try:
        return (
            _from_xml(mi, file) if file.suffix.lower() == ".xml" else (_from_mesh(mi, file), None)
        )
    except RuntimeError as error:
        raise ValueError(f"Mitsuba cannot load the scene {str(file)!r}: {error}") from error


def _from_xml(mi: Any, file: Path) -> tuple[dict[str, Any], float]:
    scene = mi.load_file(str(file))
    if not scene.shapes():
        raise ValueError(f"the scene {str(file)!r} has no shape")
    parts = {f"shape_{i}": shape for i, shape in enumerate(scene.shapes())}
    for i, emitter in enumerate(scene.emitters()):
        if mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface):
            continue  # comes with its shape
        is_point = "position" in mi.traverse(emitter)
        parts["light" if is_point and "light" not in parts else f"emitter_{i}"] = emitter
    sensor = mi.traverse(scene.sensors()[0])
    if "x_fov" not in sensor:
        raise ValueError(f"the sensor of the scene {str(file)!r} must be of type 'perspective'")
    return parts, float(np.ravel(sensor["x_fov"])[0])


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


def _check_xml(file: Path) -> None:
    elements = list(_elements(file, file.parent, {file}))
    tags = {element.tag for element in elements}
    for tag, role in (("sensor", "its field of view"), ("emitter", "light")):
        if tag not in tags:
            raise ValueError(
                f"the scene {str(file)!r} has no {tag}: add a <{tag}> element, which gives {role}"
            )


def _elements(file: Path, folder: Path, seen: set[Path]) -> Iterator[Element]:
    """Every element of a scene and of the files that it includes; checks what they name."""
    try:
        root = ElementTree.parse(file).getroot()
    except ElementTree.ParseError as error:
        raise ValueError(f"{str(file)!r} is not well-formed XML: {error}") from error
    if root.tag != "scene":
        raise ValueError(f"{str(file)!r} is not a Mitsuba scene: its root element is <{root.tag}>")
    defaults = {e.get("name", ""): e.get("value", "") for e in root.iter("default")}
    for element in root.iter():
        yield element
        for name in _named_files(element):
            named = _inside(_substituted(name, defaults), file, folder)
            if element.tag == "include" and named not in seen:
                yield from _elements(named, folder, seen | {named})


def _named_files(element: Element) -> list[str]:
    """The files that an element names."""
    if element.tag == "include":
        return [element.get("filename", "")]
    if element.tag == "path":
        return [element.get("value", "")]
    if element.tag == "string" and element.get("name") in _FILE_NAMES:
        return [element.get("value", "")]
    return [value for key, value in element.items() if key in ("filename", "file")]


def _substituted(name: str, defaults: dict[str, str]) -> str:
    """Put the scene's own defaults in place of $parameters, longest names first."""
    for key in sorted(defaults, key=len, reverse=True):
        name = name.replace(f"${key}", defaults[key])
    return name


def _inside(name: str, file: Path, folder: Path) -> Path:
    """Return the path of a file that a scene names, which must be in the scene's folder."""
    path = (file.parent / name).resolve()
    if not path.is_relative_to(folder):
        raise ValueError(
            f"the scene {str(file)!r} names {name!r}, which is outside its folder; put the scene "
            "and all its files into one folder"
        )
    if not path.exists():
        raise FileNotFoundError(f"the scene {str(file)!r} needs {str(path)!r}, which is missing")
    return path
