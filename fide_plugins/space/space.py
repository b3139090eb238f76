"""A space of named parameters: dictionaries of physical values <-> points of the unit cube."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Self

import numpy as np

from fide_plugins.errors import SpaceError, did_you_mean
from fide_plugins.space.constraints import Expression
from fide_plugins.space.group import (
    Constant,
    Group,
    Leaf,
    Member,
    Repeated,
    check_members,
    leaves,
)
from fide_plugins.space.kinds import Kind
from fide_plugins.space.layout import Layout
from fide_plugins.types import Float64, Mask
from fide_plugins.validation.points import as_point, as_points

__all__ = ["Params", "Space"]

Params = dict[str, Any]

_CONSTRAINTS = "constraints"
_NO_PARAMETER = (
    "no parameter may be called 'constraints', which are conditions on the parameters: call it "
    'otherwise, or write constraints={"wall": "inner < 0.6 * outer"}'
)


class Space(Constant):
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

    layout: where each parameter lies in the cube.

    A space cannot be changed; spaces of the same parameters in the same order, with the same
    constraints, are equal.  Raises SpaceError (a ValueError).
    """

    layout: Layout
    _members: dict[str, Member]
    _expressions: tuple[Expression, ...]
    _leaves: list[Leaf]

    def __init__(
        self,
        members: Mapping[str, Member] | None = None,
        /,
        *,
        constraints: Any = None,  # a mapping; typed so that Space(**floats) is well typed
        **named: Member,
    ) -> None:
        expressions = _expressions(constraints)
        if isinstance(members, Mapping) and _CONSTRAINTS in members:
            raise SpaceError(_NO_PARAMETER)
        checked = check_members("Space", members, named)
        found = list(leaves(checked))
        layout = Layout([leaf.kind for leaf in found])
        if layout.dim == 0:
            raise SpaceError(
                "Space needs a parameter that can vary, but each is a Choice of one value; add one"
            )
        self.__dict__.update(
            _members=checked,
            _leaves=found,
            layout=layout,
            _expressions=expressions,
            _key=(*checked.items(), expressions),
        )
        kinds = _nested(checked, iter([leaf.kind for leaf in found]))
        for expression in expressions:
            expression.check(kinds)

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
        return {one.name: one.text for one in self._expressions}

    def violations(self, params: Mapping[str, Any]) -> dict[str, float]:
        """By how much each constraint is violated by `params`, as of `decode`; 0 where it holds."""
        return {one.name: one.violation(params) for one in self._expressions}

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
        point: Float64 = snapped[0] if one else snapped
        return point

    # -- as data -----------------------------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionaries, lists, texts and numbers, for JSON; see `from_dict`.

        Raises SpaceError if a Choice has values that JSON does not have.
        """
        from fide_plugins.space import files

        data = files.to_dict(self._members)
        return data | ({_CONSTRAINTS: self.constraints} if self._expressions else {})

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Space of `data`, a dictionary as `to_dict` gives it, or as a TOML file holds it.

        Raises SpaceError, naming table and key.
        """
        from fide_plugins.space import files

        constraints = data.get(_CONSTRAINTS) if isinstance(data, Mapping) else None
        if constraints is None:
            return cls(files.from_dict(data))
        _expressions(constraints)  # it may be meant as a parameter, perhaps the only one
        members = {key: value for key, value in data.items() if key != _CONSTRAINTS}
        return cls(files.from_dict(members), constraints=constraints)

    def to_toml(self) -> str:
        """Text of a TOML file that `read` reads."""
        from fide_plugins.space import files

        return files.to_toml(self.to_dict())

    @classmethod
    def from_toml(cls, text: str) -> Self:
        """Space of the text of a TOML file; raises as `read`."""
        from fide_plugins.space import files

        return cls.from_dict(files.parse_toml(text))

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write a TOML file at `path`; raises OSError if that cannot be done."""
        from fide_plugins.runtime.files import write_text

        write_text(path, self.to_toml())

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Space of the TOML file at `path`: a table for each parameter.

        Raises SpaceError, naming file, table and key, and OSError if the file cannot be read.
        """
        from fide_plugins.space import files

        try:
            return cls.from_dict(files.read_toml(path))
        except SpaceError as error:
            raise SpaceError(f"{os.fspath(path)}: {error}") from None

    # -- as a value --------------------------------------------------------------------------------

    def __repr__(self) -> str:
        words = [
            name + (f"[{member.times}]" if isinstance(member, Repeated) else "")
            for name, member in self._members.items()
        ]
        if len(words) > 8:
            words = [*words[:6], "...", words[-1]]
        return f"Space({', '.join(words)}; dim {self.dim})"


def _expressions(given: object) -> tuple[Expression, ...]:
    """Constraints of a space as the user gives them; raises SpaceError."""
    if given is None:
        return ()
    if not isinstance(given, Mapping) or given.get("type") in ("float", "int", "choice"):
        raise SpaceError(_NO_PARAMETER)
    if any(isinstance(text, Mapping) or not isinstance(name, str) for name, text in given.items()):
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
