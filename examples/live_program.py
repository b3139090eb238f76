"""Fit a program that stays open and is driven by a socket, as TouchDesigner and Processing are.

    python examples/live_program.py          # a short run
    python examples/live_program.py 2000     # the run of the page "Fit a program that stays open"

The program is a viewer of a GLSL shader, the marble of `shader.py`, in a process of its own.  For
each line of JSON it sets the shader's uniforms, writes the picture and answers with a line.
Without moderngl or OpenGL it says so and ends.
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from fide_plugins import fit


def view() -> None:
    """The program: prints its port, then serves one connection."""
    draw = import_module("shader").Marble()
    with socket.create_server(("127.0.0.1", 0)) as server:
        print(server.getsockname()[1], flush=True)
        connection, _ = server.accept()
    with connection, connection.makefile("r", encoding="utf-8") as lines:
        for line in lines:
            p = json.loads(line)
            Image.fromarray(draw(p)).save(p["out"])
            connection.sendall(b"done\n")


class Viewer:
    """A connection to the running program."""

    def __init__(self, port: int, folder: str) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=60)
        self.answers = self.socket.makefile("r", encoding="utf-8")
        self.out = Path(folder, "picture.png")

    def render(self, p: dict[str, float]) -> NDArray[np.uint8]:
        """Image (96, 96, 3)."""
        self.socket.sendall(json.dumps({**p, "out": str(self.out)}).encode() + b"\n")
        if self.answers.readline() != "done\n":
            raise ConnectionError("the program has ended")
        return np.array(Image.open(self.out))


def main(budget: int) -> None:
    marble = import_module("shader")
    command = [sys.executable, __file__, "view"]
    with (
        tempfile.TemporaryDirectory() as folder,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as run,
    ):
        assert run.stdout is not None and run.stderr is not None
        port = run.stdout.readline()
        if not port:
            print(f"no shader here: {run.stderr.read().splitlines()[-1]}")
            print("pip install moderngl; apt-get install libegl1 libgl1-mesa-dri")
            return
        viewer = Viewer(int(port), folder)
        target, out = viewer.render(marble.TRUTH), Path(f"runs/live-{budget}")
        how: dict[str, Any] = {"workers": 0, "seed": 0, "out": out, "resume": True}
        result = fit(viewer.render, target, marble.SPACE, budget=budget, **how)
        viewer.answers.close()
        viewer.socket.close()  # then the program ends
    print(result)
    for name, true in marble.TRUTH.items():
        print(f"{name:9} {true:>6}  {result.params[name]:.3g}")
    print(f"look at {out}/summary.png")


if __name__ == "__main__":
    if sys.argv[1:] == ["view"]:
        view()
    else:
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 300)
