"""Named parameters of a renderer, and the unit cube in which they are searched.

    from fide_plugins import Choice, Float, Group, Int, Space
    space = Space(azimuth=Float(-60, 60, unit="deg"), beads=6 * Group(x=Float(0, 1), y=Float(0, 1)))

=================  =================================================================================
file               idea
=================  =================================================================================
`kinds`            what one parameter is: `Float`, `Int`, `Choice`
`group`            parameters of one thing, and several things of one kind: `Group`
`arguments`        wrong arguments of a parameter are errors with the right word
`synonyms`         other words for what a parameter is given
`layout`           numbers of all parameters <-> points of the cube, for many points at once
`expressions`      conditions on parameters as a text: ``inner < 0.6 * outer``
`space`            names: `Space`
`constraints`      by how much a point violates conditions of a space and a function of the user's
`dictionary`       a space <-> plain dictionaries (JSON)
`toml_file`        a space <-> a file in TOML
=================  =================================================================================
"""

from fide_plugins.space.group import Group, Repeated
from fide_plugins.space.kinds import Choice, Float, Int, Kind
from fide_plugins.space.space import Space

__all__ = ["Choice", "Float", "Group", "Int", "Kind", "Repeated", "Space"]
