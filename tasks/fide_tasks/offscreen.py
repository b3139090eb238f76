"""An image of a MuJoCo model without a screen: the OpenGL context, what is drawn, and its end.

On Linux the context is one of EGL, which needs neither a display nor a GPU.  Elsewhere, or where
the environment variable MUJOCO_GL names another library, it is the one that MuJoCo chooses.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import weakref
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

REMEDY = (
    "install EGL and Mesa (on Debian and Ubuntu: apt-get install libegl1 libgl1-mesa-dri), "
    "or the driver of your GPU with its EGL library"
)
"""What to do where there is no OpenGL."""

_LOCK = threading.RLock()  # contexts come and go one at a time
_open = threading.local()  # its `contexts`: those that are open in a thread, the current one last
_THREADS = "LP_NUM_THREADS"  # of llvmpipe, read with the first context; a fork waits for them
_opened_by: int | None = None  # the process that made the first context
_outlives_fork = False  # whether a forked process may go on with what this one has opened


class OffscreenError(RuntimeError):
    """There is no OpenGL to draw with."""


def import_mujoco() -> Any:
    """Return the module `mujoco`; ImportError that says what to do if it cannot be imported."""
    try:
        import mujoco
    except ModuleNotFoundError as error:
        if error.name != "mujoco":
            raise
        from fide_plugins.runtime.machine import missing

        what = "this task renders with MuJoCo, which is not installed"
        raise missing("robot", what) from None
    except (AttributeError, OSError, RuntimeError) as error:  # it loads what MUJOCO_GL names
        setting = os.environ.get("MUJOCO_GL", "")
        raise ImportError(
            f"MuJoCo cannot be imported ({error}) with MUJOCO_GL={setting!r}: "
            f"unset MUJOCO_GL, and {REMEDY}"
        ) from error
    return mujoco


class Stage:
    """A model with the memory, lamps and camera that its images need; for one thread at a time.

    Attributes
    ----------
    data: MuJoCo's state of the model; its kinematics say where everything is when it is drawn.
    """

    def __init__(self, model: Any, size: tuple[int, int], camera: Any) -> None:
        """Prepare images of (height, width) pixels; `camera` is an mjvCamera.

        Raises OffscreenError.
        """
        self._mujoco = mujoco = import_mujoco()
        self._model, self._camera, (height, width) = model, camera, size
        self.data = mujoco.MjData(model)
        self._options = mujoco.MjvOption()
        self._options.sitegroup[:] = 0
        self._scene = mujoco.MjvScene(model, maxgeom=2 * model.ngeom + 16)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        model.vis.global_.offheight, model.vis.global_.offwidth = size
        model.vis.quality.offsamples = 0
        self._view = mujoco.MjrRect(0, 0, width, height)
        self._pixels = np.empty((height, width, 3), np.uint8)
        self._context = _Context(mujoco, model, size)
        self._finalizer = weakref.finalize(self, self._context.free)

    def close(self) -> None:
        """Free the memory of OpenGL."""
        self._finalizer()

    @contextlib.contextmanager
    def open(self) -> Iterator[None]:
        """Within this context, and in this thread, `draw` may be called."""
        with self._context.current():
            yield

    def draw(self, out: NDArray[np.float32]) -> None:
        """Draw what `data` describes into out, (height, width, 3), values in [0, 1]."""
        mujoco, everything = self._mujoco, self._mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self._model, self.data, self._options, None, self._camera, everything, self._scene
        )
        mujoco.mjr_render(self._view, self._scene, self._context.renderer)
        mujoco.mjr_finish()
        mujoco.mjr_readPixels(self._pixels, None, self._view, self._context.renderer)
        np.multiply(self._pixels[::-1], np.float32(1 / 255), out=out)  # OpenGL counts rows upward


class _Context:
    """An OpenGL context with the model in its memory; `renderer` is MuJoCo's mjrContext."""

    def __init__(self, mujoco: Any, model: Any, size: tuple[int, int]) -> None:
        self.renderer: Any = None
        with _LOCK:
            _check_process()
            try:
                with _single_threaded():
                    self._gl = _context_class(mujoco)(size[1], size[0])
                    self._process = os.getpid()
                    try:
                        with self.current():
                            self._upload(mujoco, model, size)
                            _note_process()
                    except BaseException:
                        self._free()
                        raise
            except OffscreenError:
                raise
            except Exception as error:  # PyOpenGL, EGL and MuJoCo each have their own
                reason = " ".join(str(error).split()) or type(error).__name__
                raise OffscreenError(
                    f"MuJoCo found no OpenGL to draw with ({reason}); {REMEDY}"
                ) from error

    def _upload(self, mujoco: Any, model: Any, size: tuple[int, int]) -> None:
        try:
            self.renderer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50.value)
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self.renderer)
            if (self.renderer.offHeight, self.renderer.offWidth) != size:
                raise ValueError("the buffer is smaller")
        except (ValueError, mujoco.FatalError) as error:
            raise OffscreenError(
                f"OpenGL cannot draw images of {size[0]} x {size[1]} pixels here ({error}): choose "
                "a smaller size"
            ) from error

    @contextlib.contextmanager
    def current(self) -> Iterator[None]:
        """Make it the context of this thread, and afterwards the one that was open before, or none.

        Another one may be freed at any time in the middle of a frame, by the garbage collector.
        """
        if self._process != os.getpid():
            _check_process()
        contexts: list[_Context] = _open.__dict__.setdefault("contexts", [])
        contexts.append(self)
        try:
            self._gl.make_current()
            yield
        finally:
            contexts.pop()
            if contexts:
                contexts[-1]._gl.make_current()
            else:
                self._release()

    def _release(self) -> None:
        egl = _egl_of(self._gl)
        if egl is not None:
            nothing = egl.EGL.EGL_NO_SURFACE
            egl.EGL.eglMakeCurrent(egl.EGL_DISPLAY, nothing, nothing, egl.EGL.EGL_NO_CONTEXT)

    def free(self) -> None:
        """Give the memory back; in a forked process it is left to the one that it belongs to."""
        egl = _egl_of(self._gl)
        if self._process != os.getpid() or (egl is not None and egl.EGL_DISPLAY is None):
            return  # the latter at the end of the process, when EGL has been ended already
        with _LOCK:
            self._free()

    def _free(self) -> None:
        with self.current():
            if self.renderer is not None:
                self.renderer.free()  # here, since it would do so with any context at its own end
        self._gl.free()


def _context_class(mujoco: Any) -> Any:
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    if sys.platform == "linux" and chosen not in ("glfw", "glx", "osmesa"):
        from mujoco.egl import GLContext

        return GLContext
    return mujoco.GLContext


def _egl_of(context: Any) -> Any:
    """The module of MuJoCo that a context of EGL comes from; None if it is of another library."""
    module = sys.modules[type(context).__module__]
    return module if hasattr(module, "EGL_DISPLAY") else None


@contextlib.contextmanager
def _single_threaded() -> Iterator[None]:
    """Keep llvmpipe to the thread that draws, unless the user has said how many it may have."""
    before = os.environ.get(_THREADS)
    os.environ.setdefault(_THREADS, "0")
    try:
        yield
    finally:
        if before is None:
            del os.environ[_THREADS]


def _note_process() -> None:
    """Remember which process made the first context, and whether a fork of it may draw."""
    global _opened_by, _outlives_fork
    if _opened_by is None:
        from OpenGL import GL

        name = (GL.glGetString(GL.GL_RENDERER) or b"").decode(errors="replace")
        _opened_by = os.getpid()
        _outlives_fork = "llvmpipe" in name and os.environ.get(_THREADS) == "0"


def _check_process() -> None:
    if _opened_by not in (None, os.getpid()) and not _outlives_fork:
        raise OffscreenError(
            "this process was forked from one that has drawn already, and OpenGL does not outlive "
            "a fork: start processes with multiprocessing.get_context('spawn')"
        )
