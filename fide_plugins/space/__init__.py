"""Named parameters of a renderer, and the unit cube in which they are searched."""

from fide_plugins.space.kinds import Choice, Float, Int, Kind
from fide_plugins.space.space import Group, Repeated, Space

__all__ = ["Choice", "Float", "Group", "Int", "Kind", "Repeated", "Space"]
