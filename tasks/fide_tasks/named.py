"""The parameters of a task as a space of named parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from fide_plugins import Float, Group, Space

if TYPE_CHECKING:
    from fide_tasks.base import Parameter


def space_of(parameters: Sequence[Parameter], alike: str | None) -> Space:
    """Return the space of parameters, whose groups "bead 1", ... are a list if `alike` is "bead".

    Raises SpaceError if these differ, or are not together.
    """
    groups: dict[str, dict[str, Float]] = {}
    for p in parameters:
        kind = Float(p.low, p.high, unit=p.unit, periodic=p.periodic)
        groups.setdefault(p.group, {})[p.name.replace(" ", "_")] = kind
    several = [Group(each) for name, each in groups.items() if name.split()[0] == alike]
    others = {
        name.replace(" ", "_"): Group(each)
        for name, each in groups.items()
        if name.split()[0] != alike
    }
    if not several:
        return Space(others)
    assert alike is not None and len(set(several)) == 1, "things alike have the same parameters"
    return Space({f"{alike}s": len(several) * several[0], **others})
