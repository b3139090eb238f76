"""Parameters of one thing, and several things of one kind."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, TypeAlias

from fide_plugins.errors import SpaceError
from fide_plugins.space.kinds import Choice, Float, Int, Kind
from fide_plugins.validation.points import as_whole

__all__ = ["Constant", "Group", "Leaf", "Member", "Repeated", "check_members", "leaves"]

_MOST_COPIES = 100_000  # of a group
_IN_FILES = ("repeat", "type")  # keys of the file form


class Constant:
    """What cannot be changed, and is equal where its kind and its `_key` are."""

    _key: Any

    def __eq__(self, other: object) -> bool:
        return isinstance(other, type(self)) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(
            f"a {type(self).__name__} cannot be changed; make another one with a new {name}"
        )


class Group(Constant):
    """Parameters that belong to one thing: ``Group(x=Float(0, 1), y=Float(0, 1))``.

    ``6 * Group(...)`` are six things of one kind, which may change places: a list of six
    dictionaries when decoded.  A group may hold groups.

    named: a kind of parameter for each name, as for `Space`.
    members: the same as one dictionary.

    Raises SpaceError (a ValueError).
    """

    members: dict[str, Member]

    def __init__(self, members: Mapping[str, Member] | None = None, /, **named: Member) -> None:
        checked = check_members("Group", members, named)
        for name in _IN_FILES:
            if name in checked:
                raise SpaceError(
                    f"no member of a Group may be called {name!r}, which has a meaning in files; "
                    f"call it {name}_"
                )
        self.__dict__.update(members=checked, _key=tuple(checked.items()))

    def __mul__(self, times: int) -> Repeated:
        return Repeated(self, times)

    __rmul__ = __mul__

    def __repr__(self) -> str:
        return f"Group({', '.join(f'{n}={m!r}' for n, m in self.members.items())})"


class Repeated(Constant):
    """Several things of one kind, ``times * group``."""

    group: Group
    times: int

    def __init__(self, group: Group, times: int) -> None:
        number = as_whole(times) or 0
        if not 1 <= number <= _MOST_COPIES:
            raise SpaceError(
                f"a Group may be repeated 1 to {_MOST_COPIES} times, not {times!r}; write "
                "6 * Group(...), in a file repeat = 6"
            )
        if any(leaf.block for leaf in leaves(group.members)):
            raise SpaceError(
                f"a repeated Group cannot hold another repeated Group, as {group!r} does; write "
                "the inner ones under names of their own"
            )
        self.__dict__.update(group=group, times=number, _key=(number, group))

    def __repr__(self) -> str:
        return f"{self.times} * {self.group!r}"


Member: TypeAlias = Kind | Group | Repeated


class Leaf(NamedTuple):
    """One parameter of a space.

    name: flat, such as "beads[2].x".
    block: (name of the repeated group, number of the copy), or None.
    """

    name: str
    kind: Kind
    block: tuple[str, int] | None


def check_members(owner: str, members: object, named: Mapping[str, object]) -> dict[str, Member]:
    """Members by name; SpaceError if there are none, or names or kinds are wrong."""
    if members is not None and not isinstance(members, Mapping):
        raise SpaceError(f"{owner} takes names: {owner}(x=Float(0, 1)), not {members!r}")
    given = {**(members or {}), **named}
    if not given or len(given) < len(members or {}) + len(named):
        raise SpaceError(
            f"{owner} needs at least one parameter, and each of them once, not "
            f"{[*(members or {}), *named]}; write {owner}(x=Float(0, 1))"
        )
    for name, member in given.items():
        if not isinstance(name, str) or not name.isidentifier():
            raise SpaceError(
                f"the name of a parameter must be an identifier (letters, digits, _), not {name!r}"
            )
        if not isinstance(member, Float | Int | Choice | Group | Repeated):
            raise SpaceError(
                f"parameter {name!r} must be a Float, Int, Choice or Group, such as Float(0, 1), "
                f"not {member!r}"
            )
    return given


def leaves(
    members: Mapping[str, Member], prefix: str = "", block: tuple[str, int] | None = None
) -> Iterator[Leaf]:
    """All parameters below, in order."""
    for key, member in members.items():
        name = prefix + key
        if isinstance(member, Group):
            yield from leaves(member.members, f"{name}.", block)
        elif isinstance(member, Repeated):
            for i in range(member.times):
                yield from leaves(member.group.members, f"{name}[{i}].", (name, i))
        else:
            yield Leaf(name, member, block)
