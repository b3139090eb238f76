"""A scene of a disk, whose function can be sent to any process: it needs nothing of this folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from fide_plugins import Float, Space

SPACE = Space(x=Float(0, 1), y=Float(0, 1), radius=Float(0.1, 0.5), gray=Float(0, 1))
ANSWER = {"x": 0.7, "y": 0.35, "radius": 0.3, "gray": 0.9}


def disk(misfortune: str = "", log: Path | None = None) -> Callable[[dict[str, float]], Any]:
    """Function of the parameters that draws a soft disk of 16 x 16 pixels.

    misfortune: what happens where x > 0.9, or in the fifth render where there is a log.
    log: file that gets one character for each render.
    """
    path = None if log is None else str(log)

    def render(params: dict[str, float]) -> Any:
        import os
        import signal
        import struct
        import sys
        import time

        import numpy as np

        now = params["x"] > 0.9
        if path is not None:
            with open(path, "a") as file:
                file.write(".")
            now = os.path.getsize(path) == 5
        unlucky = misfortune if now else ""
        if unlucky == "raises":
            raise ValueError("too far to the right")
        if unlucky == "dies":
            os.kill(os.getpid(), signal.SIGKILL)
        if unlucky == "dies while it sends":  # the length of a message, and a part of it
            frame = sys._getframe()
            while "result_queue" not in frame.f_locals:
                assert frame.f_back is not None
                frame = frame.f_back
            results = frame.f_locals["result_queue"]._writer.fileno()
            os.write(results, struct.pack("!i", 10**6) + b"ten bytes.")
            os.kill(os.getpid(), signal.SIGKILL)
        if unlucky == "hangs":
            time.sleep(100)
        if unlucky == "wrong size":
            return np.zeros((8, 8, 3))
        if unlucky == "returns nothing":
            return None
        v, u = np.mgrid[0:16, 0:16] / 15
        distance = np.hypot(u - params["x"], v - params["y"])
        image = params["gray"] / (1 + np.exp(20 * (distance - params["radius"])))
        return image * np.nan if unlucky == "nan" else image

    return render


def target() -> Any:
    """Its picture at the answer, with a corner that it never draws: no fit is over before time."""
    picture = disk()(ANSWER)
    picture[:3, :3] += 0.1
    return picture
