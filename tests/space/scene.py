"""A small picture of ten numbers, an integer and a choice: a disk over a floor."""

from __future__ import annotations

from typing import Any

import numpy as np

from fide_plugins import Choice, Float, Int, Space
from fide_plugins.types import Float32, Float64

SIZE = 32
SCENE = Space(
    x=Float(0, 1), y=Float(0.2, 0.8), radius=Float(0.05, 0.3, log=True),
    red=Float(0, 1), green=Float(0, 1), blue=Float(0, 1),
    sky=Float(0, 1), dark=Float(0, 0.5), light=Float(0.5, 1),
    turn=Float(0, 360, unit="deg", periodic=True),
    columns=Int(3, 8), floor=Choice("checker", "stripes", "dots"),
)  # fmt: skip


def render(params: dict[str, Any]) -> Float32:
    """Return the picture, (32, 32, 3) in [0, 1]; `turn` is where the sky is brightest."""
    v, u = (np.indices((SIZE, SIZE)) + 0.5) / SIZE
    tiles = _floor(params["floor"], params["columns"], u, v)
    floor = params["dark"] + (params["light"] - params["dark"]) * tiles
    sky = params["sky"] * (0.75 + 0.25 * np.cos(2 * np.pi * u - np.radians(params["turn"])))
    image = np.where(v > 0.5, floor, sky)[..., None].repeat(3, axis=-1)
    distance = np.hypot(u - params["x"], v - params["y"]) - params["radius"]
    disk = _soft(-distance * SIZE)[..., None]
    color = np.array([params["red"], params["green"], params["blue"]])
    return np.asarray(image * (1 - disk) + color * disk, np.float32)


def _floor(kind: str, columns: int, u: Float64, v: Float64) -> Float64:
    a, b = np.sin(np.pi * columns * u), np.sin(np.pi * columns * (v - 0.5))
    if kind == "checker":
        return _soft(SIZE / columns * a * b)
    if kind == "stripes":
        return _soft(SIZE / columns * a)
    return _soft(SIZE / columns * (np.abs(a * b) - 0.5))


def _soft(distance: Float64) -> Float64:
    """Coverage of a pixel at this distance from an edge."""
    return np.asarray(1 / (1 + np.exp(-np.clip(2 * distance, -50, 50))))


def truth(seed: int) -> dict[str, Any]:
    """Parameters of the target of a seed; every integer and choice comes up in turn."""
    x = np.random.default_rng((seed, 1)).uniform(0.15, 0.85, SCENE.dim)
    drawn = SCENE.decode(x)
    drawn["columns"] = 3 + seed % 6
    drawn["floor"] = ("checker", "stripes", "dots")[seed % 3]
    drawn["radius"] = max(drawn["radius"], 0.1)
    return drawn
