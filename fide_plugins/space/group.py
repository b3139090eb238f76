"""Parameters of one thing, and several things of one kind."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, NamedTuple, TypeAlias

from fide_plugins.errors import SpaceError
from fide_plugins.space.kinds import Choice, Float, Int, Kind
from fide_plugins.validation.points import as_whole

__all__ = ["Constant", "Group", "Leaf", "Member", "Repeated", "check_members", "leaves"]

_MOST_COPIES = 100_000  # of a group
_IN_FILES = ("repeat", "type")  # keys of the file form


class Constant:
    """What cannot be changed, and is equal where its kind and its `_key` are."""

    _noun: ClassVar[str]
    _key: Any

    def __eq__(self, other: object) -> bool:
        return isinstance(other, type(self)) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(
            f"a {self._noun} cannot be changed; make another one with a new {name}"
        )


class Group(Constant):
    """Parameters that belong to one thing: ``Group(x=Float(0, 1), y=Float(0, 1))``.

    ``6 * Group(...)`` are six things of one kind, which may change places: a list of six
    dictionaries when decoded.  A group may hold groups.

    named: a kind of parameter for each name, as for `Space`.
    members: the same as one dictionary.

    Raises SpaceError (a ValueError).
    """

    _noun = "Group"
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

    _noun = "repeated Group"
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
                "a repeated Group cannot hold another repeated Group; write the inner ones under "
                "names of their own"
            )
        self.__dict__.update(group=group, times=number, _key=(number, group))

    def __rmul__(self, times: object) -> Repeated:
        raise SpaceError(
            f"a repeated Group cannot be repeated, {times!r} * ({self.times} * Group(...)); write "
            "one number, the product"
        )

    __mul__ = __rmul__

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
    if len(given) < len(members or {}) + len(named):
        twice = next(name for name in named if name in (members or {}))
        raise SpaceError(f"parameter {twice!r} is given twice to {owner}; drop one")
    if not given:
        raise SpaceError(f"{owner} needs at least one parameter: {owner}(x=Float(0, 1))")
    for name, member in given.items():
        _check_name(name)
        if not isinstance(member, Float | Int | Choice | Group | Repeated):
            raise SpaceError(
                f"parameter {name!r} must be a Float, Int, Choice or Group, not {member!r}"
                f"{_remedy(member)}"
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


def _check_name(name: object) -> None:
    if not isinstance(name, str):
        raise SpaceError(
            f"the name of a parameter must be a text, not {name!r}; write it in quotes"
        )
    if not name.isidentifier():
        shape = "".join(c if c.isalnum() else "_" for c in name) or "x"
        better = shape if shape.isidentifier() else f"_{shape}"
        raise SpaceError(
            f"the name of a parameter must be an identifier (letters, digits, _), not {name!r}; "
            f"call it {better!r}"
        )


def _remedy(member: object) -> str:
    if isinstance(member, type) and issubclass(member, Float | Int | Choice | Group):
        return f"; call it: {member.__name__}(...)"
    if isinstance(member, tuple | list) and len(member) == 2:
        return f"; write Float({member[0]!r}, {member[1]!r})"
    if isinstance(member, Mapping):
        return "; write Group(...), or Space.from_dict for plain data"
    return ""
