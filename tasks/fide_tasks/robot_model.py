"""The model of the robot: our own, a file of the user's, or MuJoCo Menagerie's; and the room.

A model that brings a floor (a plane of the world) keeps all that it brings.  One without is put
into our room, of a floor, a lamp and a sky, and its own lamps are left out.
"""

from __future__ import annotations

import importlib
import logging
import re
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fide_tasks import panda
from fide_tasks.offscreen import import_mujoco

__all__ = ["find", "joints", "load"]

_log = logging.getLogger(__name__)
_OWN = Path(__file__).parent / "mjcf" / "panda.xml"
_FLOOR = 60.0  # m, half its side; an endless one takes 1.5 ms longer to draw
_EXTENT = 1.0  # m, unit of the range of depths (to 50 m) and of the reach of shadows
_SHADOWS = 2.0  # m around the robot, within which there are shadows
_SHADOW_MAP = 2048  # pixels along a side; twice as many take twice the time
_TOLERANCE = 0.01  # m and rad by which the axes of a Panda may be elsewhere


def find(model: str | PathLike[str] | None) -> Path:
    """Return the file of a model: None is our own; "menagerie" is that of robot_descriptions.

    Raises FileNotFoundError if there is none, ImportError if robot_descriptions is needed and is
    not installed, OSError if it cannot bring the model.
    """
    if model is None:
        return _OWN
    if model == "menagerie":
        return _in_menagerie()
    if not isinstance(model, (str, PathLike)):
        raise TypeError(f"model must be a path, 'menagerie' or None, not {model!r}")
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

    They are the hinges whose names end in joint1 to joint7 (as panda_joint1); where names say
    nothing, the model must have exactly seven hinges.

    Raises ValueError if it has no such joints.
    """
    mujoco = import_mujoco()
    hinges = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
    names = {int(j): model.joint(j).name for j in hinges}
    numbered: dict[int, int] = {}
    for joint, name in names.items():
        match = re.search(r"(?<!finger_)joint_?([1-7])$", name)
        if match:
            numbered.setdefault(int(match[1]), joint)
    if len(numbered) == panda.JOINTS:
        found = [numbered[i + 1] for i in range(panda.JOINTS)]
    elif len(hinges) == panda.JOINTS:
        found = list(names)
    else:
        listed = ", ".join(name or "(no name)" for name in names.values()) or "none"
        raise ValueError(
            f"the model {str(file)!r} is not a Panda: it must have seven hinge joints, of names "
            f"that end in joint1 to joint7, but it has {len(names)} ({listed})"
        )
    _compare(mujoco, model, found, file)
    return np.array(found, np.intp)


def _compare(mujoco: Any, model: Any, found: list[int], file: Path) -> None:
    """Say where a model is another arm than the Panda; it is rendered nevertheless."""
    data = mujoco.MjData(model)
    q = np.array([0.3, -0.4, 0.5, -1.2, 0.6, 1.4, 0.7])
    data.qpos[model.jnt_qposadr[found]] = q
    mujoco.mj_kinematics(model, data)
    poses = panda.frames(q)[: panda.JOINTS]
    away = poses[:, :3, 3] - data.xanchor[found]
    axes = data.xaxis[found]
    off_axis = away - (away * axes).sum(axis=1, keepdims=True) * axes
    turned = poses[:, :3, 2] - axes
    worst = np.maximum(np.linalg.norm(off_axis, axis=1), np.linalg.norm(turned, axis=1))
    if worst.max() > _TOLERANCE:
        number = 1 + int(np.argmax(worst > _TOLERANCE))
        _log.warning(
            "the axis of joint %d of the model %s is elsewhere than a Panda's whose base is at the "
            "origin: it is rendered, but targets may be seen badly", number, file,
        )  # fmt: skip


def _in_menagerie() -> Path:
    try:
        module = importlib.import_module("robot_descriptions.panda_mj_description")
    except ModuleNotFoundError as error:
        raise ImportError(
            f"model='menagerie' needs the package robot_descriptions ({error}): pip install "
            "robot_descriptions, or pass the path of a panda.xml of MuJoCo Menagerie"
        ) from error
    except Exception as error:  # it fetches the model by git, which fails in many ways
        reason = " ".join(str(error).split()) or type(error).__name__
        raise OSError(
            f"robot_descriptions cannot bring the Panda of MuJoCo Menagerie ({reason}); pass the "
            "path of a panda.xml instead"
        ) from error
    return Path(module.MJCF_PATH)


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
