"""Named parameters of a renderer, and the unit cube in which they are searched.

from fide_plugins import Choice, Float, Group, Int, Space
space = Space(azimuth=Float(-60, 60, unit="deg"), beads=6 * Group(x=Float(0, 1), y=Float(0, 1)))
"""

from fide_plugins.space.kinds import Choice, Float, Int, Kind
from fide_plugins.space.space import Group, Repeated, Space

__all__ = ["Choice", "Float", "Group", "Int", "Kind", "Repeated", "Space"]
