"""A space of named parameters: dictionaries of physical values <-> points of the unit cube."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple, Self, TypeAlias, get_args

import numpy as np

from fide_plugins.errors import SpaceError, did_you_mean
from fide_plugins.runtime.files import read_regular
from fide_plugins.space.constraints import Expression, sample_of
from fide_plugins.space.kinds import Choice, Kind
from fide_plugins.space.layout import Layout
from fide_plugins.types import Float64, Mask
from fide_plugins.validation.points import as_point, as_points, as_whole

Params = dict[str, Any]

_KINDS: dict[str, type[Kind]] = {kind.type: kind for kind in get_args(Kind)}
_PLAIN = (str, int, float, bool, type(None))
_MOST_BYTES = 2**24  # of a file: 200,000 parameters
_MOST_COPIES = 100_000  # of a group
_IN_FILES = ("repeat", "type")  # keys of the file form
_CONSTRAINTS = "constraints"
_NO_PARAMETER = (
    "no parameter may be called 'constraints', which are conditions on the parameters: call it "
    'otherwise, or write constraints={"wall": "inner < 0.6 * outer"}'
)


@dataclass(frozen=True, init=False, repr=False)
class Group:
    """Parameters that belong to one thing: ``Group(x=Float(0, 1), y=Float(0, 1))``.

    ``6 * Group(...)`` are six things of one kind, which may change places: a list of six
    dictionaries when decoded.  A group may hold groups.

    named: a kind of parameter for each name, as for `Space`.
    members: the same as one dictionary.

    Raises SpaceError (a ValueError).
    """

    items: tuple[tuple[str, Member], ...]

    def __init__(self, members: Mapping[str, Member] | None = None, /, **named: Member) -> None:
        checked = _check_members("Group", members, named)
        for name in _IN_FILES:
            if name in checked:
                raise SpaceError(
                    f"no member of a Group may be called {name!r}, which has a meaning in files; "
                    f"call it {name}_"
                )
        object.__setattr__(self, "items", tuple(checked.items()))

    @property
    def members(self) -> dict[str, Member]:
        """What each name is."""
        return dict(self.items)

    def __mul__(self, times: int) -> Repeated:
        return Repeated(self, times)

    __rmul__ = __mul__

    def __repr__(self) -> str:
        return f"Group({', '.join(f'{n}={m!r}' for n, m in self.members.items())})"


@dataclass(frozen=True, repr=False)
class Repeated:
    """Several things of one kind, ``times * group``."""

    group: Group
    times: int

    def __post_init__(self) -> None:
        number = as_whole(self.times) or 0
        if not 1 <= number <= _MOST_COPIES:
            raise SpaceError(
                f"a Group may be repeated 1 to {_MOST_COPIES} times, not {self.times!r}; write "
                "6 * Group(...), in a file repeat = 6"
            )
        if any(leaf.block for leaf in _leaves_of(self.group.members)):
            raise SpaceError(
                f"a repeated Group cannot hold another repeated Group, as {self.group!r} does; "
                "write the inner ones under names of their own"
            )
        object.__setattr__(self, "times", number)

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


def _check_members(owner: str, members: object, named: Mapping[str, object]) -> dict[str, Member]:
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
        if not isinstance(member, Member):
            raise SpaceError(
                f"parameter {name!r} must be a Float, Int, Choice or Group, such as Float(0, 1), "
                f"not {member!r}"
            )
    return given


def _leaves_of(
    members: Mapping[str, Member], prefix: str = "", block: tuple[str, int] | None = None
) -> Iterator[Leaf]:
    """All parameters below, in order."""
    for key, member in members.items():
        name = prefix + key
        if isinstance(member, Group):
            yield from _leaves_of(member.members, f"{name}.", block)
        elif isinstance(member, Repeated):
            for i in range(member.times):
                yield from _leaves_of(member.group.members, f"{name}[{i}].", (name, i))
        else:
            yield Leaf(name, member, block)


@dataclass(frozen=True, init=False, repr=False)
class Space:
    """Parameters by name, each a `Float`, `Int`, `Choice` or `Group` of such.

    >>> from fide_plugins import Choice, Float, Group, Int, Space
    >>> beads = 2 * Group(x=Float(0, 1))
    >>> space = Space(azimuth=Float(-60, 60, unit="deg"), columns=Int(3, 8), beads=beads)
    >>> space
    Space(azimuth, columns, beads[2]; dim 4)
    >>> space.decode([0.5, 0.9, 0.25, 0.75])
    {'azimuth': 0.0, 'columns': 8, 'beads': [{'x': 0.25}, {'x': 0.75}]}
    >>> space.encode({"azimuth": 30, "columns": 3, "beads": [{"x": 0}, {"x": 1}]})
    array([0.75      , 0.08333333, 0.        , 1.        ])

    named: a `Float`, `Int`, `Choice`, `Group` or repeated `Group` for each name.
    members: the same as one dictionary, ``Space({"azimuth": Float(-60, 60)})``.
    constraints: conditions by name, ``{"wall": "inner < 0.6 * outer"}`` (`space.constraints`);
        nothing else is rendered.  So no parameter may be called "constraints".

    A space cannot be changed; spaces of the same parameters in the same order, with the same
    constraints, are equal.  Raises SpaceError (a ValueError).
    """

    items: tuple[tuple[str, Member], ...]
    expressions: tuple[Expression, ...]

    def __init__(
        self,
        members: Mapping[str, Member] | None = None,
        /,
        *,
        constraints: Any = None,  # a mapping; typed so that Space(**floats) is well typed
        **named: Member,
    ) -> None:
        if isinstance(members, Mapping) and _CONSTRAINTS in members:
            raise SpaceError(_NO_PARAMETER)
        object.__setattr__(self, "expressions", _expressions(constraints))
        checked = _check_members("Space", members, named)
        object.__setattr__(self, "items", tuple(checked.items()))
        if self.dim == 0:
            raise SpaceError(
                "Space needs a parameter that can vary, but each is a Choice of one value; add one"
            )
        sample = _nested(self._members, iter([sample_of(leaf.kind) for leaf in self._leaves]))
        for expression in self.expressions:
            expression.check(sample)

    @property
    def _members(self) -> dict[str, Member]:
        return dict(self.items)

    @cached_property
    def _leaves(self) -> list[Leaf]:
        return list(_leaves_of(self._members))

    @cached_property
    def layout(self) -> Layout:
        """Where each parameter lies in the cube."""
        return Layout([leaf.kind for leaf in self._leaves])

    @property
    def dim(self) -> int:
        """Number of axes of the cube: one a parameter, but n for a choice of n > 2 values."""
        return self.layout.dim

    @property
    def names(self) -> list[str]:
        """Flat names of the parameters, such as "azimuth" and "beads[2].x", in order."""
        return [leaf.name for leaf in self._leaves]

    @property
    def parameters(self) -> dict[str, Kind]:
        """What each parameter is, by flat name."""
        return {leaf.name: leaf.kind for leaf in self._leaves}

    @property
    def axes(self) -> dict[str, list[int]]:
        """Indices of the axes of each parameter, by flat name."""
        slices = zip(self._leaves, self.layout.slices, strict=True)
        return {leaf.name: list(range(s.start, s.stop)) for leaf, s in slices}

    @property
    def constraints(self) -> dict[str, str]:
        """Conditions on the parameters by name, as they were written; {} without."""
        return {one.name: one.text for one in self.expressions}

    def violations(self, params: Mapping[str, Any]) -> dict[str, float]:
        """By how much each constraint is violated by `params`, as of `decode`; 0 where it holds."""
        return {one.name: one.violation(params) for one in self.expressions}

    @property
    def periodic(self) -> Mask:
        """(dim,), axes whose ends are the same."""
        return self.layout.periodic.copy()

    @property
    def families(self) -> dict[str, list[list[int]]]:
        """Blocks of axes that may change places, by the name of their group."""
        found: dict[str, list[list[int]]] = {}
        for leaf, s in zip(self._leaves, self.layout.slices, strict=True):
            if leaf.block is not None:
                name, number = leaf.block
                blocks = found.setdefault(name, [])
                if number == len(blocks):
                    blocks.append([])
                blocks[number].extend(range(s.start, s.stop))
        return {name: blocks for name, blocks in found.items() if len(blocks) > 1 and blocks[0]}

    @property
    def largest_family(self) -> list[list[int]]:
        """Blocks of the family that has most; [] if there is none."""
        return max(self.families.values(), key=len, default=[])

    @property
    def groups(self) -> list[list[int]]:
        """Blocks of axes that may change places with others of their family; [] if none."""
        return [block for blocks in self.families.values() for block in blocks]

    def decode(self, x: object) -> Params:
        """Values of a point x (dim,) of the cube: float, int, or the choice's own value.

        Groups are dictionaries, repeated ones lists of dictionaries.  Raises PointsError.
        """
        return self.decode_many(as_point(x, self.dim)[None])[0]

    def decode_many(self, X: object) -> list[Params]:
        """Values of points X (n, dim) of the cube, see `decode`."""
        numbers = self.layout.numbers(as_points(X, self.dim)).tolist()
        kinds = [leaf.kind for leaf in self._leaves]
        rows = ([k.value(n) for k, n in zip(kinds, row, strict=True)] for row in numbers)
        return [_nested(self._members, iter(row)) for row in rows]

    def encode(self, params: Mapping[str, Any]) -> Float64:
        """Point (dim,) of `params`, as of `decode`: decode(encode(p)) is p but for rounding.

        An integer or a choice is put in the middle of its cell.  Raises SpaceError (a ValueError)
        if a name is missing or unknown, or a value is out of its range.
        """
        x: Float64 = self.encode_many([params])[0]
        return x

    def encode_many(self, many: Sequence[Mapping[str, Any]]) -> Float64:
        """Points (n, dim) of `many`, n dictionaries; see `encode`, for its errors as well."""
        rows = [list(_numbers(self._members, params, "")) for params in many]
        return self.layout.points(np.array(rows, np.float64).reshape(len(rows), len(self._leaves)))

    def snap(self, X: object) -> Float64:
        """Points (n, dim), or (dim,), that stand for what is rendered at X.

        Integers and choices go to the middle of their cells, other coordinates stay:
        decode(snap(x)) is decode(x), and encode(decode(x)) is snap(x) but for rounding.
        """
        one = np.ndim(X) == 1  # type: ignore[arg-type]
        snapped = self.layout.snap(as_points([X] if one else X, self.dim))
        return snapped.reshape(-1) if one else snapped

    # -- as data -----------------------------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionaries, lists, texts and numbers, for JSON; see `from_dict`.

        Raises SpaceError if a Choice has values that JSON does not have.
        """
        data = _as_data(self._members)
        return data | ({_CONSTRAINTS: self.constraints} if self.expressions else {})

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Space of `data`, a dictionary as `to_dict` gives it, or as a TOML file holds it.

        Raises SpaceError, naming table and key.
        """
        constraints = data.get(_CONSTRAINTS) if isinstance(data, Mapping) else None
        if constraints is not None:
            _expressions(constraints)  # it may be meant as a parameter, perhaps the only one
            data = {key: value for key, value in data.items() if key != _CONSTRAINTS}
        return cls(_members_from(data), constraints=constraints)

    @classmethod
    def from_toml(cls, text: str) -> Self:
        """Space of the text of a TOML file; raises as `read`."""
        try:
            data = tomllib.loads(text)
        except (ValueError, RecursionError) as error:  # also a number of 5,000 digits
            raise SpaceError(f"no TOML: {error}; write [name] and below it key = value") from None
        return cls.from_dict(data)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Space of the TOML file at `path`: a table for each parameter.

        Raises SpaceError, naming file, table and key, and OSError if the file cannot be read.
        """
        try:
            return cls.from_toml(read_regular(path, _MOST_BYTES).decode("utf-8-sig"))  # of Windows
        except UnicodeDecodeError as error:
            why = f"{os.fspath(path)}: no TOML: {error}; save it as UTF-8"
            raise SpaceError(why) from None
        except SpaceError as error:
            raise SpaceError(f"{os.fspath(path)}: {error}") from None

    # -- as a value --------------------------------------------------------------------------------

    def __repr__(self) -> str:
        times = {k: m.times for k, m in self._members.items() if isinstance(m, Repeated)}
        words = [f"{k}[{times[k]}]" if k in times else k for k in self._members]
        if len(words) > 8:
            words = [*words[:6], "...", words[-1]]
        return f"Space({', '.join(words)}; dim {self.dim})"


def _expressions(given: object) -> tuple[Expression, ...]:
    """Constraints of a space as the user gives them; raises SpaceError."""
    if given is None:
        return ()
    if (
        not isinstance(given, Mapping)
        or given.get("type") in _KINDS
        or any(
            isinstance(text, Mapping) or not isinstance(name, str) for name, text in given.items()
        )
    ):
        raise SpaceError(_NO_PARAMETER)
    return tuple(Expression(name, text) for name, text in given.items())


def _nested(members: Mapping[str, Member], values: Iterator[Any]) -> Params:
    """Dictionaries and lists of values, one for each parameter below, in order."""
    made: Params = {}
    for key, member in members.items():
        if isinstance(member, Group):
            made[key] = _nested(member.members, values)
        elif isinstance(member, Repeated):
            made[key] = [_nested(member.group.members, values) for _ in range(member.times)]
        else:
            made[key] = next(values)
    return made


def _numbers(members: Mapping[str, Member], params: object, prefix: str) -> Iterator[float]:
    """Numbers of the parameters below, in order; `prefix` is that of their flat names."""
    if not isinstance(params, Mapping):
        what = repr(prefix[:-1]) if prefix else "params"
        names = ", ".join(members)
        raise SpaceError(f"{what} must be a dictionary with the keys {names}, not {params!r}")
    for key in params:
        if key not in members:
            raise SpaceError(
                f"unknown parameter {f'{prefix}{key}'!r}; known are {', '.join(members)}"
                f"{did_you_mean(key, members)}"
            )
    if missing := [repr(prefix + key) for key in members if key not in params]:
        raise SpaceError(f"missing parameter {', '.join(missing)}; give a value for each")
    for key, member in members.items():
        name, value = prefix + key, params[key]
        if isinstance(member, Group):
            yield from _numbers(member.members, value, f"{name}.")
        elif isinstance(member, Repeated):
            if not isinstance(value, list | tuple) or len(value) != member.times:
                raise SpaceError(
                    f"parameter {name!r} must be a list of {member.times} dictionaries, not "
                    f"{value!r}"
                )
            for i, each in enumerate(value):
                yield from _numbers(member.group.members, each, f"{name}[{i}].")
        else:
            yield member.number(name, value)


# -- plain data ------------------------------------------------------------------------------------
#
# {"azimuth": {"type": "float", "low": -60.0, "high": 60.0}, "beads": {"repeat": 6, "x": {...}}}
#
# What has a key besides tables and "repeat" is a parameter, all else is a group.  Without a "type"
# it is a choice if it has "values", and else a float.


def _as_data(members: Mapping[str, Member], prefix: str = "") -> dict[str, Any]:
    """Plain data of the members of a space or group."""
    data: dict[str, Any] = {}
    for key, member in members.items():
        name = prefix + key
        if isinstance(member, Repeated):
            data[key] = {"repeat": member.times, **_as_data(member.group.members, f"{name}.")}
        elif isinstance(member, Group):
            data[key] = _as_data(member.members, f"{name}.")
        elif isinstance(member, Choice):
            values = [_plain(f"parameter {name!r}", value) for value in member.values]
            data[key] = {"type": "choice", "values": values}
        else:
            given = {one.name: (getattr(member, one.name), one.default) for one in fields(member)}
            data[key] = {"type": member.type} | {k: v for k, (v, d) in given.items() if v != d}
    return data


def _plain(where: str, value: Any) -> Any:
    """A value of a choice; SpaceError for one that files cannot hold."""
    value = value.item() if isinstance(value, np.generic) else value
    if type(value) not in _PLAIN:
        raise SpaceError(
            f"{where} has the value {value!r}, which files cannot hold; use texts and look the "
            "objects up by them"
        )
    return value


def _members_from(data: object) -> dict[str, Member]:
    """Members of a space; SpaceError naming table and key if it is none."""
    if not isinstance(data, Mapping) or not data:
        raise SpaceError(
            f"a space must be a dictionary of parameters, at least one, not {data!r}; write a "
            "table for each, such as [x] with low = 0, high = 1"
        )
    try:
        return {key: _member(key, value) for key, value in data.items()}
    except RecursionError:
        raise SpaceError("tables are nested too deeply; write fewer groups in each other") from None


def _member(table: str, data: object) -> Member:
    try:
        if not isinstance(data, Mapping) or not data:
            raise SpaceError(
                f"must be a table, not {data!r}; write [{table}] and below it low = 0, high = 1"
            )
        inner = {key: value for key, value in data.items() if key != "repeat"}
        if any(not isinstance(value, Mapping) for value in inner.values()):
            return _parameter(data)
        if not inner:
            raise SpaceError("is empty; write low = 0, high = 1 below it, or tables of its own")
        group = Group({key: _member(f"{table}.{key}", value) for key, value in inner.items()})
        return group * data["repeat"] if "repeat" in data else group
    except SpaceError as error:
        if str(error).startswith("["):  # an inner table has said where
            raise
        raise SpaceError(f"[{table}] {error}") from None


def _parameter(data: Mapping[str, Any]) -> Kind:
    name = data.get("type", "choice" if "values" in data else "float")
    if not isinstance(name, str) or name not in _KINDS:
        hint = did_you_mean(name, _KINDS)
        raise SpaceError(f"type: must be one of {', '.join(_KINDS)}, not {name!r}{hint}")
    kind = _KINDS[name]
    values = {key: value for key, value in data.items() if key != "type"}
    known = [each.name for each in fields(kind)]
    for key in values:
        if key not in known:
            hint = did_you_mean(key, known)
            raise SpaceError(f"{key}: unknown key; {name} has type, {', '.join(known)}{hint}")
    for key in ("values",) if kind is Choice else ("low", "high"):
        if key not in values:
            raise SpaceError(f"{key}: missing; write {key} = ... below it")
    if kind is not Choice:
        return kind(**values)
    if not isinstance(values["values"], list | tuple):
        raise SpaceError(f'values: must be a list such as ["a", "b"], not {values["values"]!r}')
    return Choice(*(_plain("values:", value) for value in values["values"]))
