"""A mesh of the user's own in place of the courtyard."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

__all__ = ["checked_scene", "load"]

_SUFFIXES = (".obj", ".ply")


def checked_scene(path: str | PathLike[str]) -> Path:
    """Return the absolute path of a mesh.

    Raises FileNotFoundError if it is missing; ValueError if it is of another kind than OBJ or PLY.
    """
    file = Path(path).expanduser().resolve()
    if file.suffix.lower() not in _SUFFIXES:
        raise ValueError(
            f"scene must be a mesh of type {', '.join(_SUFFIXES)}, not {str(path)!r}: fit a scene "
            "with other files by a renderer of your own, fide fit --renderer"
        )
    if not file.is_file():
        raise FileNotFoundError(f"there is no scene file {str(file)!r}")
    return file


def load(mi: Any, file: Path) -> Any:
    """Load a mesh for `mi.load_dict`, in gray, or in the colors of its vertices.

    Raises ValueError with Mitsuba's reason if it cannot be loaded, or if nothing is in it.
    """

    def shape(color: dict[str, Any]) -> Any:
        surface = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": color}}
        kind = file.suffix.lower().removeprefix(".")
        return mi.load_dict({"type": kind, "filename": str(file), "bsdf": surface})

    try:
        mesh = shape({"type": "rgb", "value": 0.5})
        if mesh.face_count() == 0:
            raise ValueError(f"Mitsuba cannot load the scene {str(file)!r}: it has no triangle")
        if "vertex_color" in mi.traverse(mesh):
            mesh = shape({"type": "mesh_attribute", "name": "vertex_color"})
    except RuntimeError as error:
        raise ValueError(f"Mitsuba cannot load the scene {str(file)!r}: {error}") from error
    return mesh
