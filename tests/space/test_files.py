"""Spaces in files: what is written is read, and what is wrong is named."""

from __future__ import annotations

from pathlib import Path

import pytest

from fide_plugins import Choice, Float, Group, Int, Space
from fide_plugins.errors import SpaceError

GOOD = """
[azimuth]
type = "float"
low = -60
high = 60
unit = "deg"
periodic = true

[roughness]
type = "float"
low = 0.002
high = 0.2
log = true

[columns]
type = "int"
low = 3
high = 8

[floor]
type = "choice"
values = ["checker", "wood"]

[beads]
repeat = 6

[beads.x]
type = "float"
low = 0
high = 1

[beads.y]
type = "float"
low = 0
high = 1
"""


def test_a_good_file(tmp_path: Path) -> None:
    file = tmp_path / "space.toml"
    file.write_text(GOOD)
    space = Space(
        azimuth=Float(-60, 60, unit="deg", periodic=True),
        roughness=Float(0.002, 0.2, log=True),
        columns=Int(3, 8),
        floor=Choice("checker", "wood"),
        beads=6 * Group(x=Float(0, 1), y=Float(0, 1)),
    )
    assert Space.read(file) == space
    assert Space.from_toml(GOOD) == space == Space.from_dict(space.to_dict())


BAD = [
    ("[a]\nmin = 0\nmax = 1", r"\[a\] min: unknown key; float has type, low, high"),
    ('[a]\nlow = 0\nhigh = 1\nunits = "m"', r"\[a\] units: unknown key.*; did you mean 'unit'\?"),
    ("[a]\nlow = 0", r"\[a\] high: missing; write high = "),
    ('[a]\ntype = "flaot"\nlow = 0\nhigh = 1', r"\[a\] type: must be one of .*mean 'float'"),
    ('[a]\ntype = "float"\nlow = 1\nhigh = 0', r"\[a\] Float\(1.0, 0.0\): low must be less than"),
    ('[a]\ntype = "float"\nlow = "x"\nhigh = 0', r"\[a\] Float\('x', 0\): low must be a finite"),
    ('[a]\ntype = "choice"\nvalues = "wood"', r"\[a\] values: must be a list"),
    ('[a]\ntype = "choice"\nvalues = []', r"\[a\] Choice needs 1 to 1000 values"),
    ('[a]\ntype = "choice"\nvalues = [["b"], "c"]', r"\[a\] values: .* files cannot hold"),
    ("[a]\nrepeat = 3", r"\[a\] is empty; write low = 0, high = 1 below it"),
    ("[a]", r"\[a\] must be a table, .* write \[a\] and below it low = 0"),
    ('[a]\nrepeat = 0\n[a.x]\ntype = "int"\nlow = 0\nhigh = 1', r"\[a\] a Group may be repeated"),
    ("[a]\nrepaet = 3\n[a.x]\n", r"\[a\] repaet: unknown key"),
    ('[a]\n[a.x]\ntype = "int"\nlow = 3', r"\[a.x\] high: missing"),
    ('["a b"]\ntype = "int"\nlow = 0\nhigh = 1', "the name of .* not 'a b'"),
    ("a = 3", r"\[a\] must be a table, not 3"),
    ("", r"a space must be a dictionary of parameters, at least one.*such as \[x\]"),
    ("[a\n", "no TOML: .*line 1"),
]


def test_without_a_type_it_is_a_float_or_what_its_values_say() -> None:
    text = '[a]\nlow = 0\nhigh = 1\n[b]\nvalues = ["x", "y"]\n'
    text += "[c]\nrepeat = 2\n[c.low]\nlow = 1\nhigh = 2\n"
    space = Space.from_toml(text)
    assert space == Space(a=Float(0, 1), b=Choice("x", "y"), c=2 * Group(low=Float(1, 2)))


@pytest.mark.parametrize(("text", "message"), BAD)
def test_a_bad_file_is_named_with_table_and_key(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "space.toml"
    file.write_text(text)
    with pytest.raises(SpaceError, match=f"space.toml: {message}"):
        Space.read(file)


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nothing.toml"):
        Space.read(tmp_path / "nothing.toml")
    (tmp_path / "picture.toml").write_bytes(b"\x89PNG\xff")
    with pytest.raises(SpaceError, match="picture.toml: no TOML.*save it as UTF-8"):
        Space.read(tmp_path / "picture.toml")
    (tmp_path / "windows.toml").write_text('[x]\ntype = "float"\nlow = 0\nhigh = 1', "utf-8-sig")
    assert Space.read(tmp_path / "windows.toml") == Space(x=Float(0, 1))
    with pytest.raises(SpaceError, match="a space must be a dictionary"):
        Space.from_dict([1, 2])  # type: ignore[arg-type]
