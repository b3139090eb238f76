"""A server of the Model Context Protocol: agents check renderers, and fit them.

    fide mcp

An agent that writes a scene starts this command, which uses standard input and output.  The agent
calls `check` with the scene, `fit` with a picture, `status` until the fit has ended, and looks at
`picture`.  Needs the extra mcp.  The agent's programs run with your rights, as in a shell of yours.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

from fide_plugins.cli.terminal import complain
from fide_plugins.runtime.machine import missing

GUIDE = """FIDE finds the parameters of a renderer that make a given picture.

A renderer is FILE.py:NAME, a function that takes a dictionary of parameters and returns an image
(height, width, 3), floats in [0, 1] or uint8, of the target's size; or a command line with {out}
for the image it writes and {NAME} for each parameter.  The file of the space has a table for each
parameter:

    [radius]
    type = "float"        # or "int"; low and high are included
    low = 0.1
    high = 0.5
    # log = true          # for positive ranges over decades
    # periodic = true     # for an angle
    [material]
    type = "choice"
    values = ["wood", "stone"]

Beside FILE.py, a Space in its variable `space` does, too.  Small pictures (100 pixels) and 50 to
100 renders for each parameter are enough for a first fit.  Call check first: it shows whether each
parameter changes the image.  Then fit, status until its "state" is not "running", and picture.
"""
_FIDE = (sys.executable, "-m", "fide_plugins")


def _arguments(renderer: str | None, command: str | None, space: str | None, *flag: str) -> Any:
    """Arguments of the command line for a renderer; flag: of `renderer`, if it has one."""
    if (renderer is None) == (command is None):
        raise ValueError("name a renderer (FILE.py:NAME), or a command with {out}; one of them")
    what = ["--command", str(command)] if renderer is None else [*flag, renderer]
    return what if space is None else [*what, "--space", space]


class Tools:
    """What an agent can call; the docstrings and signatures are what it reads."""

    def __init__(self) -> None:
        self._started: dict[Path, tuple[subprocess.Popen[bytes], Path]] = {}  # and their messages

    def describe(self) -> str:
        """What FIDE does, and how to write the renderer and the file of its parameters."""
        return GUIDE

    def check(
        self, renderer: str | None = None, command: str | None = None, space: str | None = None
    ) -> dict[str, Any]:
        """Look at a renderer before a fit: what each parameter changes, time, noise, failures."""
        done = subprocess.run(
            [*_FIDE, "check", *_arguments(renderer, command, space), "--json"],
            stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False,
        )  # fmt: skip
        if done.returncode:
            raise ValueError(done.stderr.strip() or f"fide check exited with {done.returncode}")
        found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
        return found

    def fit(
        self, target: str, out: str, renderer: str | None = None, command: str | None = None,
        space: str | None = None, budget: int = 2000, seed: int = 0, wait: float = 20.0,
        resume: bool = False, options: list[str] | None = None,
    ) -> dict[str, Any]:  # fmt: skip
        """Start a fit of the picture `target`; returns its status after at most `wait` seconds.

        out: the run directory.  options: more flags of `fide fit`, such as ["--mask", "m.png"].
        """
        words = [target, *_arguments(renderer, command, space, "--renderer"), "--budget", budget]
        words += ["--seed", seed, *["--resume"] * resume, *(options or []), "--out", out]
        if self._is_running(out):
            raise ValueError(f"a fit in {out} is running; wait, stop it, or name another folder")
        Path(out).parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(prefix="fide-mcp-", suffix=".log", delete=False) as log:
            process = subprocess.Popen(
                [*_FIDE, "fit", *map(str, words)], stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )
        self._started[Path(out).resolve()] = process, Path(log.name)
        end = time.monotonic() + wait
        while self._is_running(out) and time.monotonic() < end:
            time.sleep(0.1)
        return self.status(out)

    def status(self, out: str) -> dict[str, Any]:
        """State of the fit in a run directory: parameters found so far, loss, what is known."""
        found: dict[str, Any] = {"out": out, "state": "starting"}
        try:
            run = json.loads(Path(out, "run.json").read_text("utf-8"))
            found |= {key: run[key] for key in ("state", "status", "totals") if key in run}
            found["params"] = (run.get("totals") or {}).get("params")
        except (OSError, ValueError):
            run = None
        if self._is_running(out):
            return {**found, "state": "running"}
        if Path(out).resolve() not in self._started:
            if run is None:
                raise ValueError(f"there is no run in {out}; start one with fit")
            return found
        process, log = self._started[Path(out).resolve()]
        found["messages"] = log.read_text("utf-8", "replace")[-2000:]
        if process.returncode and found["state"] in ("starting", "running"):
            found["state"] = "failed"
        return found

    def stop(self, out: str) -> dict[str, Any]:
        """Stop a fit; what it has found is saved, and `fit` with resume=true goes on."""
        self.stop_all(Path(out).resolve())
        return self.status(out)

    def picture(self, out: str) -> Any:
        """Target, best image and difference of a fit; its best image alone while it runs."""
        from mcp.server.mcpserver import Image

        for name in ("summary.png", "best.png", "check.png"):
            if (Path(out) / name).is_file():
                return Image(path=Path(out) / name)
        raise ValueError(f"there is no picture in {out} yet; ask status")

    def stop_all(self, *only: Path) -> None:
        """Stop all fits, or those in some folders."""
        for path in only or self._started:
            if path in self._started:
                process, _ = self._started[path]
                process.terminate()
                process.wait(60)

    def _is_running(self, out: str) -> bool:
        process, _ = self._started.get(Path(out).resolve(), (None, None))
        return process is not None and process.poll() is None


def server(tools: Tools) -> Any:
    """The server with its tools, a `mcp.server.mcpserver.MCPServer`."""
    from mcp.server.mcpserver import MCPServer
    from mcp.server.mcpserver.exceptions import ToolError

    def answering(function: Callable[..., Any]) -> Callable[..., Any]:
        """The same function; its ValueErrors are answers, which the agent reads."""

        @wraps(function)
        def told(**arguments: Any) -> Any:
            try:
                return function(**arguments)
            except ValueError as error:
                raise ToolError(str(error)) from error

        return told

    made = MCPServer("fide", instructions=GUIDE)
    for tool in (tools.describe, tools.check, tools.fit, tools.status, tools.stop, tools.picture):
        made.add_tool(answering(tool), structured_output=False)
    return made


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """``fide mcp`` has no arguments."""


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Serve until standard input ends; returns the exit code."""
    tools = Tools()
    try:
        made = server(tools)
    except ImportError as error:
        why = f"an agent's server needs the package mcp ({error})"
        return complain("fide mcp", str(missing("mcp", why)))
    try:
        made.run()
    finally:
        tools.stop_all()
    return 0
