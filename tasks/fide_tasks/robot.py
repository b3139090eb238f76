"""Robot: the joint angles of a Franka Emika Panda, from a picture of it (paper, Sec. 4.2 and S1).

Notation: q [7] joint angles in rad, base to hand; T_i [4, 4] pose of link i in the base, in m.

Only kinematics are computed: q determines the poses of all links, which are drawn. There is no time
step, and the arm may pass through itself or the floor.
"""

from __future__ import annotations

import contextlib
import threading
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fide_tasks import isolated, panda
from fide_tasks.base import Image, Parameter, Task, Vector
from fide_tasks.offscreen import OffscreenError, Stage, import_mujoco

_MODEL = Path(__file__).parent / "mjcf" / "panda.xml"
_CHECK_SECONDS = 60.0  # limit for the first frame, which usually takes less than one second
_CHECK = """
import sys
from fide_tasks.robot import Robot
try:
    Robot(8).render([[0.5] * 7])
except Exception as error:
    sys.exit(" ".join(str(error).split()) or type(error).__name__)
"""


class Robot(Task):
    """A robot arm whose pose in the picture is to be found.

    The 7 parameters are the joint angles, from the lower to the upper of the published limits.

    Options
    -------
    target: the user's own picture, float (H, W, 3) in [0, 1], instead of a generated one.

    The x_star of a generated target depends on `seed` alone, its picture on all options. It is a
    pose that touches neither itself nor the floor, as far as links of simple shape can tell, of
    which our camera sees nearly all, and the long links from the side.

    A pixel is what lies at its center: links move from pixel to pixel in steps. One frame takes
    about 2.5 ms at 224 x 224 on one core without a GPU.
    """

    name = "robot"
    parameters = tuple(
        Parameter(f"joint {i + 1}", "angle", "rad", low, high)
        for i, (low, high) in enumerate(panda.LIMITS)
    )

    def __init__(
        self, size: int | tuple[int, int] = 224, seed: int = 0, *, target: ArrayLike | None = None
    ) -> None:
        super().__init__(size, seed, target=target)
        self._model: Any = import_mujoco().MjModel.from_xml_path(str(_MODEL))
        joints = [self._model.joint(f"joint{i + 1}").id for i in range(panda.JOINTS)]
        self._places = self._model.jnt_qposadr[joints]
        self._stage: Stage | None = None
        self._lock = threading.Lock()

    def check(self) -> None:
        """Draw a frame of the built-in arm in another process, since an OpenGL driver may crash.

        Raises OffscreenError if that fails.
        """
        problem = isolated.failure(_CHECK, seconds=_CHECK_SECONDS)
        if problem is not None:
            raise OffscreenError(f"no frame was drawn: {problem}")

    def close(self) -> None:
        """Free the memory of OpenGL; the next render allocates it again."""
        with self._lock:
            if self._stage is not None:
                self._stage.close()
            self._stage = None

    def _render(self, values: Vector, out: Image, seeds: NDArray[np.uint32]) -> None:
        if not len(values):
            return
        with self._lock:
            if self._stage is None:
                self._stage = Stage(self._model, self.size, self._view())
            with self._stage.open():
                for q, frame in zip(values, out, strict=True):
                    self._pose(self._stage.data, q)
                    self._stage.draw(frame)

    def _pose(self, data: Any, q: Vector) -> None:
        """Set the joints and compute the poses of links, lamps and cameras."""
        mujoco = import_mujoco()
        data.qpos[self._places] = q
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_comPos(self._model, data)
        mujoco.mj_camlight(self._model, data)

    def _view(self) -> Any:
        mujoco = import_mujoco()
        view = mujoco.MjvCamera()
        view.lookat[:] = panda.LOOK_AT
        view.distance = panda.DISTANCE
        view.azimuth, view.elevation = panda.AZIMUTH, panda.ELEVATION
        height, width = self.size
        half = np.tan(np.radians(panda.FOV / 2)) * max(1.0, height / width)
        self._model.vis.global_.fovy = 2 * np.degrees(np.arctan(half))
        return view

    def _make_x_star(self) -> Vector:
        rng = np.random.default_rng((self.seed, self.dim))
        while True:  # a third of the draws pass
            x = rng.uniform(0.05, 0.95, self.dim)
            if panda.is_good(self._physical(x)):
                return x

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what belongs to this process."""
        state = dict(self.__dict__)
        del state["_lock"]
        return {**state, "_stage": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock = threading.Lock()

    def __del__(self, suppress: Any = contextlib.suppress) -> None:
        with suppress(Exception):  # as an argument: at the end of the program modules are gone
            self.close()
