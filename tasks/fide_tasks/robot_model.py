"""The model of the robot, our own or a file such as MuJoCo Menagerie's panda.xml; and the room.

A model that brings a floor (a plane of the world) keeps all that it brings.  One without is put
into our room, of a floor, a lamp and a sky, and its own lamps are left out.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fide_tasks import panda
from fide_tasks.offscreen import import_mujoco

__all__ = ["find", "joints", "load"]

_OWN = Path(__file__).parent / "mjcf" / "panda.xml"
_FLOOR = 60.0  # m, half its side; an endless one takes 1.5 ms longer to draw
_EXTENT = 1.0  # m, unit of the range of depths (to 50 m) and of the reach of shadows
_SHADOWS = 2.0  # m around the robot, within which there are shadows
_SHADOW_MAP = 2048  # pixels along a side; twice as many take twice the time


def find(model: str | PathLike[str] | None) -> Path:
    """Return the file of a model, None being our own; FileNotFoundError if there is none."""
    if model is None:
        return _OWN
    if not isinstance(model, (str, PathLike)):
        raise TypeError(f"model must be a path or None, not {model!r}")
    file = Path(model).expanduser().resolve()
    if not file.is_file():
        raise FileNotFoundError(f"there is no model file {str(file)!r}")
    return file


def load(file: Path) -> Any:
    """Compile the model in a file, with a room around it.

    Raises FileNotFoundError if a file that it names is missing, ValueError with MuJoCo's reason if
    it is malformed.
    """
    mujoco = import_mujoco()
    try:
        spec = mujoco.MjSpec.from_file(str(file))
        _furnish(mujoco, spec)
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())
        message = f"MuJoCo cannot load the model {str(file)!r}: {reason}"
        if "error opening file" in reason.lower():
            raise FileNotFoundError(
                f"{message}; the meshes of a model must lie where it says, in or beside its folder"
            ) from error
        raise ValueError(message) from error


def joints(model: Any, file: Path) -> NDArray[np.intp]:
    """Return the numbers of the seven joints of the arm, base to hand, in a compiled model.

    They are the hinges whose names end in joint1 to joint7 (as panda_joint1).  Raises ValueError if
    there are none.
    """
    hinge = import_mujoco().mjtJoint.mjJNT_HINGE
    hinges = {model.joint(int(j)).name: int(j) for j in np.flatnonzero(model.jnt_type == hinge)}
    ends = [f"joint{i + 1}" for i in range(panda.JOINTS)]
    found = [[j for name, j in hinges.items() if name.endswith(end)] for end in ends]
    if not all(found):
        raise ValueError(
            f"the model {str(file)!r} is not a Panda: it must have seven hinge joints, of names "
            f"that end in joint1 to joint7, but it has {', '.join(hinges) or 'none'}"
        )
    return np.array([joint[0] for joint in found], np.intp)


def _furnish(mujoco: Any, spec: Any) -> None:
    """Add the room, unless the model has a floor."""
    world, visual = spec.worldbody, spec.visual
    spec.stat.extent, visual.map.shadowclip = _EXTENT, _SHADOWS
    visual.quality.shadowsize = _SHADOW_MAP
    visual.quality.numslices, visual.quality.numstacks, visual.quality.numquads = 20, 12, 1
    if any(geom.type == mujoco.mjtGeom.mjGEOM_PLANE for geom in world.geoms):
        return
    for lamp in list(spec.lights):
        spec.delete(lamp)
    visual.headlight.ambient, visual.headlight.diffuse = [0.38, 0.38, 0.40], [0.3] * 3
    visual.headlight.specular = [0.0] * 3
    world.add_light(
        name="fide lamp", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[1.5, -0.5, 3], dir=[-0.45, 0.15, -1], diffuse=[0.5, 0.49, 0.46],
        specular=[0.3] * 3,
    )  # fmt: skip
    if not any(texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX for texture in spec.textures):
        spec.add_texture(
            name="fide sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, width=32, height=192,
            rgb1=[0.86, 0.90, 0.95], rgb2=[0.55, 0.64, 0.76],
        )  # fmt: skip
    _lay_floor(mujoco, spec)


def _lay_floor(mujoco: Any, spec: Any) -> None:
    spec.add_texture(
        name="fide tiles", type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER, width=64, height=64,
        rgb1=[0.75, 0.73, 0.70], rgb2=[0.69, 0.67, 0.65],
    )  # fmt: skip
    textures = [""] * int(mujoco.mjtTextureRole.mjNTEXROLE)
    textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = "fide tiles"
    spec.add_material(
        name="fide floor", textures=textures, texuniform=True, texrepeat=[2, 2], specular=0.0,
        reflectance=0.0,
    )  # fmt: skip
    spec.worldbody.add_geom(
        name="fide floor", type=mujoco.mjtGeom.mjGEOM_PLANE, material="fide floor",
        size=[_FLOOR, _FLOOR, 1.0], contype=0, conaffinity=0,
    )  # fmt: skip
