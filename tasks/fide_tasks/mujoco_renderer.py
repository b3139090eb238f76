"""Pictures of a MuJoCo model at many values of its joints, drawn without a window or a GPU.

OpenGL contexts belong to a process and are current in one thread at a time. A renderer makes its
own current only while it draws, and gives it back when the renderer is no longer used.
"""

from __future__ import annotations

import importlib.util
import math
import os
import sys
import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from fide_tasks.base import Image, Vector
from fide_tasks.robot_model import joint_addresses

__all__ = ["Camera", "GraphicsError", "Renderer", "require_mujoco"]

_NEAR, _FAR = 0.1, 100.0  # m; nothing nearer or farther is drawn
_SHADOW_MAP = 2048  # pixels along its side
_SHADOW_REACH = 1.5  # m around the point the camera looks at
_SLICES, _STACKS = 20, 10  # of round shapes; more are not seen in a small picture, and take longer
_THREADS = "LP_NUM_THREADS"  # of Mesa's software OpenGL, read when its first context is made


class GraphicsError(RuntimeError):
    """MuJoCo cannot draw on this machine."""


class Camera(NamedTuple):
    """A camera that looks at a point.

    lookat, distance: the point it looks at, and how far from that it is, in m.
    azimuth, elevation: direction in which it looks, from x toward y, and upward, in degrees.
    fov: width of its view across the shorter side of the image, in degrees.
    """

    lookat: tuple[float, float, float]
    distance: float
    azimuth: float
    elevation: float
    fov: float


class Renderer:
    """Draws one model at one size, in the process in which it was made."""

    def __init__(
        self, model: Any, size: tuple[int, int], camera: Camera, shadows: bool, samples: int
    ) -> None:
        """Set up OpenGL for frames of `size` (height, width).

        Raises GraphicsError, which says what to install, if there is no OpenGL without a window.
        """
        import mujoco

        self._mujoco, self._model, self._data = mujoco, model, mujoco.MjData(model)
        self._addresses = joint_addresses(model)
        self._pid = os.getpid()
        height, width = size
        _set_quality(model, height, width, camera.fov, shadows, samples)
        self._camera = _camera(mujoco, camera)
        self._options = mujoco.MjvOption()
        self._scene = mujoco.MjvScene(model, maxgeom=2 * model.ngeom + 100)
        flags = mujoco.mjtRndFlag
        self._scene.flags[flags.mjRND_SHADOW] = shadows
        for unwanted in (flags.mjRND_REFLECTION, flags.mjRND_HAZE, flags.mjRND_FOG):
            self._scene.flags[unwanted] = False
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        self._pixels = np.empty((height, width, 3), np.uint8)
        self._context = _gl_context(width, height)
        try:
            with _current(self._context):
                self._gl = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50)
                mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._gl)
        except Exception as error:
            self._context.free()
            raise GraphicsError(
                f"OpenGL cannot draw images of {height} x {width} pixels with {samples} samples: "
                f"{error}"
            ) from error
        self._finalizer = weakref.finalize(self, _free, self._context, self._gl, self._pid)
        self._finalizer.atexit = False  # with the process all of OpenGL ends

    @property
    def usable(self) -> bool:
        """Whether this renderer was made in this process, and not in one it was forked from."""
        return self._pid == os.getpid()

    def close(self) -> None:
        """Give the OpenGL context back."""
        self._finalizer()

    def draw(self, q: Vector, out: Image, times: dict[str, float]) -> None:
        """Draw the joint angles q, (n, joints), into out, (n, H, W, 3) in [0, 1]."""
        mj, model, data, clock = self._mujoco, self._model, self._data, time.perf_counter
        everything = mj.mjtCatBit.mjCAT_ALL
        with _current(self._context):
            for angles, frame in zip(q, out, strict=True):
                start = clock()
                data.qpos[self._addresses] = angles
                mj.mj_kinematics(model, data)
                mj.mj_comPos(model, data)  # which lamps may follow
                mj.mj_camlight(model, data)
                mj.mjv_updateScene(
                    model, data, self._options, None, self._camera, everything, self._scene
                )
                updated = clock()
                mj.mjr_render(self._viewport, self._scene, self._gl)
                mj.mjr_finish()
                rendered = clock()
                mj.mjr_readPixels(self._pixels, None, self._viewport, self._gl)
                np.divide(self._pixels[::-1], np.float32(255), out=frame)
                times["update"] += updated - start
                times["render"] += rendered - updated
                times["copy"] += clock() - rendered
                times["frames"] += 1


def require_mujoco() -> None:
    """Raise ImportError, which names the extra, if MuJoCo is not installed."""
    if importlib.util.find_spec("mujoco") is None:
        raise ImportError(
            "this task renders with MuJoCo, which is not installed: "
            "pip install 'fide-plugins[robot]'"
        )


def _set_quality(
    model: Any, height: int, width: int, fov: float, shadows: bool, samples: int
) -> None:
    """Set in the model what OpenGL is to draw with; nothing that is not asked for."""
    visual = model.vis
    visual.global_.offheight, visual.global_.offwidth = height, width
    across = math.tan(math.radians(fov / 2)) * height / min(height, width)
    visual.global_.fovy = math.degrees(2 * math.atan(across))
    visual.quality.offsamples = samples
    visual.quality.shadowsize = _SHADOW_MAP if shadows else 0
    visual.quality.numslices, visual.quality.numstacks = _SLICES, _STACKS
    visual.quality.numquads = 1
    model.stat.extent = 1.0  # the unit of the next three
    visual.map.znear, visual.map.zfar = _NEAR, _FAR
    visual.map.shadowclip = _SHADOW_REACH


def _camera(mujoco: Any, camera: Camera) -> Any:
    made = mujoco.MjvCamera()
    made.type = mujoco.mjtCamera.mjCAMERA_FREE
    made.lookat[:] = camera.lookat
    made.distance, made.azimuth, made.elevation = camera[1:4]
    return made


def _gl_context(width: int, height: int) -> Any:
    """Return an OpenGL context without a window, by EGL on Linux; see `GraphicsError`.

    Mesa's software OpenGL would start threads. They make such small frames no faster, and do not
    survive a fork: the forked process would wait for them forever.
    """
    chosen = os.environ.get("MUJOCO_GL", "").strip().lower()
    threads = os.environ.get(_THREADS)
    os.environ.setdefault(_THREADS, "0")
    try:
        if sys.platform == "linux" and chosen in ("", "egl"):
            from mujoco.egl import GLContext
        else:
            from mujoco.gl_context import GLContext
        return GLContext(width, height)
    except Exception as error:  # of many kinds, such as AttributeError for a library not found
        raise GraphicsError(_diagnosis(chosen, error)) from error
    finally:
        if threads is None:
            del os.environ[_THREADS]


def _diagnosis(chosen: str, error: Exception) -> str:
    if sys.platform != "linux":
        return f"MuJoCo cannot draw here ({error}); it needs OpenGL"
    if chosen not in ("", "egl"):
        return (
            f"MuJoCo cannot draw here as the environment variable MUJOCO_GL={chosen} says "
            f"({error}); unset it to draw with EGL"
        )
    platform = os.environ.get("PYOPENGL_PLATFORM", "egl")
    if platform.lower() != "egl":
        return (
            "MuJoCo draws without a window by EGL, but the environment variable "
            f"PYOPENGL_PLATFORM={platform} says otherwise: unset it"
        )
    return (
        f"MuJoCo draws without a window by EGL, which does not work here ({error}); install EGL "
        "and an OpenGL driver (without a GPU, on Debian: apt-get install libegl1 libgl1-mesa-dri)"
    )


@contextmanager
def _current(context: Any) -> Iterator[None]:
    """Make an OpenGL context current, and afterwards the one that was so before, if any.

    Before MuJoCo 4 it stays current, so that no other thread can draw with it.
    """
    if hasattr(context, "as_current"):
        with context.as_current():
            yield
    else:
        context.make_current()
        yield


def _free(context: Any, gl: Any, pid: int) -> None:
    if pid == os.getpid():  # what was forked along is not this process's to free
        with _current(context):
            gl.free()
        context.free()
