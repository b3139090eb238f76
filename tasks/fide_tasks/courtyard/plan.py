"""The ground plan: where the court, its arcades and its storeys are, and the palette.

The camera of the San Miguel task moves in x [7, 25], y [1, 10], z [-2, 12] (paper, Sec. S1). The
court lies just around that box and is open to the sky.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fide_tasks.courtyard.mesh import Frame, srgb

WEST, EAST, NORTH, SOUTH = 6.2, 25.8, -2.8, 12.8  # the edges of the court: x, x, z, z
DEPTH = 3.2  # of the arcades behind them
CENTER = (16.0, 5.0)  # x, z: the fountain

PLINTH = 0.3  # height of the arcade's floor above the paving
GALLERY = 4.7  # height of the upper floor
EAVES = 8.9  # height of the lower edge of the roof
RIDGE = 10.2  # height of its upper edge, at the outer walls
PARAPET = 10.75  # height of the outer walls


class Side(NamedTuple):
    """One side of the court: local x along it, y up, z into the court; z = 0 is its edge."""

    name: str
    frame: Frame
    length: float
    bays: int
    corners: bool  # whether this side also builds the corners of the arcade behind it

    @property
    def bay(self) -> float:
        """Width of one bay."""
        return self.length / self.bays

    @property
    def reach(self) -> float:
        """How far this side's floors go beyond its ends."""
        return DEPTH if self.corners else 0.0


SIDES = (
    Side("north", Frame((WEST, 0, NORTH), 0.0), EAST - WEST, 7, True),
    Side("south", Frame((EAST, 0, SOUTH), math.pi), EAST - WEST, 7, True),
    Side("west", Frame((WEST, 0, SOUTH), math.pi / 2), SOUTH - NORTH, 6, False),
    Side("east", Frame((EAST, 0, NORTH), -math.pi / 2), SOUTH - NORTH, 6, False),
)

CANTERA = srgb("#d3b59b")  # the pinkish stone of columns and frames
CANTERA_DARK = srgb("#b08d74")
OCHRE = srgb("#d99a3f")  # plaster of the ground floor
CREAM = srgb("#ecdcb6")  # plaster of the arcades
ROSE = srgb("#c96f52")  # plaster of the upper floor
DADO = srgb("#8c3b2a")  # painted foot of the walls
TERRACOTTA = srgb("#b5603c")
BRICK = srgb("#94492f")
SLATE = srgb("#8b8378")
GROUT = srgb("#544a40")
WOOD = srgb("#6e4428")
DARK_WOOD = srgb("#452a1a")
IRON = srgb("#23211f")
GLASS = srgb("#26323a")
TEAL = srgb("#1f6e74")
BLUE = srgb("#1f4f9c")
WHITE = srgb("#f3efe4")
WATER = srgb("#3b8f9e")
MAGENTA = srgb("#c2186b")
RED = srgb("#b3202c")
YELLOW = srgb("#e9b824")
GREEN = srgb("#2f6b34")
LEAF = srgb("#4d7f35")
BARK = srgb("#5c4836")
