"""`fide mcp`: an agent's client checks and fits a renderer, and sees the picture."""

from __future__ import annotations

import asyncio
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

pytest.importorskip("mcp")

from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client

RENDERER = """
import numpy as np
from fide_plugins import Float, Space

space = Space(x=Float(0, 1), radius=Float(0.1, 0.4))
yy, xx = np.mgrid[0:24, 0:24] / 23

def render(p):
    return 1 / (1 + np.exp(30 * (np.hypot(xx - p["x"], yy - 0.5) - p["radius"])))
"""


async def _call(client: Any, tool: str, **arguments: Any) -> tuple[Any, str]:
    result = await client.call_tool(tool, arguments)
    text = "".join(part.text for part in result.content if part.type == "text")
    return result, text


async def _over(client: Any, out: str) -> str:
    """What is said of a run once it is over."""
    end = time.monotonic() + 60
    while True:
        _, text = await _call(client, "status", out=out)
        if json.loads(text)["state"] not in ("starting", "running") or time.monotonic() > end:
            return text
        await asyncio.sleep(0.2)


async def _session(folder: Path) -> dict[str, Any]:
    """What an agent sees that fits a disk from its picture."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    start = StdioServerParameters(
        command=sys.executable, args=["-m", "fide_plugins", "mcp"], env=environment, cwd=folder
    )
    found: dict[str, Any] = {}
    async with Client(stdio_client(start)) as client:
        found["tools"] = {tool.name for tool in (await client.list_tools()).tools}
        _, found["guide"] = await _call(client, "describe")
        _, text = await _call(client, "check", renderer="disk.py:render")
        found["check"] = json.loads(text)
        found["wrong"], found["error"] = await _call(
            client, "fit", target="no.png", renderer="disk.py:render", out="runs/wrong"
        )
        if not found["wrong"].is_error:
            found["error"] = await _over(client, "runs/wrong")
        _, text = await _call(
            client, "fit", target="target.png", renderer="disk.py:render", out="runs/disk",
            budget=200, options=["--workers", "1"], wait=0,
        )  # fmt: skip
        found["first"] = json.loads(text)
        found["last"] = json.loads(await _over(client, "runs/disk"))
        found["picture"], _ = await _call(client, "picture", out="runs/disk")
        found["nothing"], found["no run"] = await _call(client, "status", out="runs/none")
    return found


@pytest.mark.thorough
def test_an_agent_fits_a_picture(tmp_path: Path) -> None:
    (tmp_path / "disk.py").write_text(RENDERER)
    names: dict[str, Any] = {}
    exec(RENDERER, names)
    image = names["render"]({"x": 0.7, "radius": 0.2})
    Image.fromarray((255 * image).round().astype("uint8")).convert("RGB").save(
        tmp_path / "target.png"
    )
    found = asyncio.run(_session(tmp_path))
    assert found["tools"] == {"describe", "check", "fit", "status", "stop", "picture"}
    assert "{out}" in found["guide"]
    assert Path(tmp_path, found["check"]["picture"]).is_file()
    assert found["wrong"].is_error or json.loads(found["error"])["state"] == "failed"
    assert "no.png" in found["error"]
    assert found["first"]["state"] == "running"
    assert found["last"]["state"] == "finished"
    assert found["last"]["params"] == pytest.approx({"x": 0.7, "radius": 0.2}, abs=0.02)
    assert [part.type for part in found["picture"].content] == ["image"]
    assert found["nothing"].is_error and "runs/none" in found["no run"]
