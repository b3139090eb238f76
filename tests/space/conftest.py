"""Spaces of every kind."""

from __future__ import annotations

import pytest

from fide_plugins import Choice, Float, Group, Int, Space


@pytest.fixture
def space() -> Space:
    """The example of the documentation."""
    return Space(
        azimuth=Float(-60, 60, unit="deg", periodic=True),
        roughness=Float(0.002, 0.2, log=True),
        columns=Int(3, 8),
        floor=Choice("checker", "wood", "stone"),
        shadows=Choice(False, True),
        light=Group(power=Int(1, 1000, log=True), place=Group(x=Float(0, 2, step=0.5))),
        beads=3 * Group(x=Float(0, 1), y=Float(0, 1)),
    )
