"""Conditions on parameters: what they mean, what is refused, and that no text is ever executed."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins import Choice, Float, Group, Int, Space
from fide_plugins.errors import SpaceError

MEMBERS: dict[str, Any] = {
    "inner": Float(0, 1),
    "outer": Float(0, 1),
    "n": Int(1, 5),
    "floor": Choice("wood", "tile"),
    "lid": Choice(True, False),
    "hub": Group(w=Float(0, 4)),
    "beads": 2 * Group(x=Float(0, 1)),
}
PARAMS = {
    "inner": 0.3, "outer": 0.4, "n": 3, "floor": "wood", "lid": True, "hub": {"w": 2.0},
    "beads": [{"x": 0.1}, {"x": 0.9}],
}  # fmt: skip


@pytest.mark.parametrize(
    ("text", "violation"),
    [
        ("inner < 0.6 * outer", 0.06),
        ("inner <= 0.6 * outer + 0.06 + 1e-9", 0.0),
        ("0 < inner < outer < 1", 0.0),
        ("1 > inner > outer >= 0", 0.1),
        ("inner > outer and outer > 1", 0.7),
        ("inner > outer or outer > 1", 0.1),
        ("not inner > outer", 0.0),
        ("floor == 'tile' or n != 4", 0.0),
        ("lid and n == 5", 2.0),
        ("sqrt(inner - 2) > 0 or inner < 1", 0.0),
        ("not (inner > 1 and sqrt(inner - 2) > 0)", 0.0),
        ("inner * 1e308 < -1e308", 1e100),
        ("not lid", 1.0),
        ("beads[1].x - beads[0].x > 0.5 and hub.w ** 2 <= 4", 0.0),
        ("max(inner, outer, -abs(-2)) == outer", 0.0),
        ('hypot(3, 4) == 5 and atan2(0, -1) == pi and floor == "wood"', 0.0),
        ("1 / 0 < 1", 1.0),  # has no value
        ("sqrt(-1) < 1", 1.0),
        ("(-1) ** 0.5 < 1", 1.0),
        ("9 ** 9 ** 9 ** 9 > 0", 1.0),
        ("exp(1000) > 0", 1.0),
        ("inner < inner", 1e-12),
        ("inner != inner", 1.0),
    ],
)
def test_by_how_much_a_condition_is_violated(text: str, violation: float) -> None:
    space = Space(MEMBERS, constraints={"wall": text})
    assert space.violations(PARAMS)["wall"] == pytest.approx(violation, abs=1e-13)


@pytest.mark.parametrize(
    "text",
    [
        "sqrt(inner - 2) != 1",
        "not (sqrt(inner - 2) < 1)",
        "max(sqrt(inner - 2), 1) > 0.2",
        "sqrt(inner - 2) ** 0 == 1",
        "inner < 1 and sqrt(inner - 2) != 1",
        "inner > 1 or sqrt(inner - 2) != 1",
    ],
)
def test_what_has_no_value_is_violated_wherever_it_stands(text: str) -> None:
    assert Space(MEMBERS, constraints={"wall": text}).violations(PARAMS)["wall"] > 0.5


@pytest.mark.parametrize(
    ("text", "valid"),
    [
        ("rows * x < 1.5", {1: True, 2: True, 4: False, "auto": False}),
        ("not (rows > 1)", {1: True, 2: False, 4: False, "auto": False}),
        ("rows == 'auto' or rows > 2", {1: False, 2: False, 4: True, "auto": True}),
        ("rows > 2 or rows == 'auto'", {1: False, 2: False, 4: True, "auto": True}),
        ("rows != 2", {1: True, 2: False, 4: True, "auto": True}),
    ],
)
def test_a_choice_of_texts_and_numbers(text: str, valid: dict[Any, bool]) -> None:
    """In any order of its values, so that none of them decides what is legal."""
    for values in ([1, 2, 4, "auto"], ["auto", 4, 1, 2]):
        space = Space(rows=Choice(*values), x=Float(0, 1), constraints={"w": text})
        found = {rows: space.violations({"rows": rows, "x": 0.5})["w"] == 0 for rows in values}
        assert found == valid


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("inner <", "is no condition"),
        ("inner := 1", "is no condition"),
        ("1or 2", "is no condition"),
        ("inner < " + "(" * 300 + "1" + ")" * 300, "is no condition"),
        ("inner < 1" + " " * 1000, "1,009 characters"),
        ("inner + 1", "is no condition; compare"),
        ("not inner", "'inner' is no condition; compare"),
        ("innr < 1", "unknown parameter 'innr'; known are inner, outer, .*did you mean 'inner'"),
        ("hub.v < 1", "unknown parameter 'hub.v'; known are w"),
        ("beads[2].x < 1", r"unknown parameter 'beads\[2\]'"),
        ("beads[-1].x < 1", "is not allowed"),
        ("beads < 1", "a group has no value"),
        ("inner < 'a'", "is no number"),
        ("floor + 1 < 1", "'floor' is no number"),
        ("(inner < 1) + 1 < 1", "not allowed"),
        ("sqrt(1, 2) < 1", "does not take 2 numbers"),
        ("erf(1) < 1", "unknown function 'erf'; .* functions sqrt"),
        ("inner == None", "not allowed"), ("lid == (n < 4)", "not allowed"),
        ("inner % 2 < 1", "not allowed; a condition has numbers"),
        ("inner in (1, 2)", "another comparison is not allowed"),
        ("f'{inner}' == 'a'", "not allowed"),
        ("(lambda: 1)() < 1", "not allowed"),
        ("__import__('os').system('true') == 0", "not allowed"),
        ("inner.__class__ == 1", "unknown parameter"),
        ("sqrt.__globals__ == 1", "unknown parameter"),
        ("max(*beads) < 1", "not allowed"),
        ("max(1, key=2) < 1", "not allowed"),
    ],
)  # fmt: skip
def test_what_is_no_condition_is_refused(text: str, message: str) -> None:
    with pytest.raises(SpaceError, match=f"(?s)^constraint wall = .*: .*({message})"):
        Space(MEMBERS, constraints={"wall": text})


def test_no_text_does_anything_but_being_refused_or_checked(tmp_path: Path) -> None:
    """Random texts of the pieces of Python raise SpaceError or nothing."""
    rng = np.random.default_rng(0)
    harm = tmp_path / "harm"
    pieces = [
        "inner", "outer", "beads", "[0]", ".x", ".", "(", ")", "[", "]", "{", "}", "<", "<=", "==",
        "+", "-", "*", "**", "/", "//", "%", "@", ",", ":", ":=", "lambda", "if", "else", "for",
        "in", "is", "not", "and", "or", "await", "yield", "f'{1}'", "'a'", '"', "'", "\\", "\0",
        "\n", "#", "1", "1e400", "0x1f", "10j", "...", "None", "True", "__class__", "__builtins__",
        "open", "eval", "exec", "__import__", "os", "max", "sqrt", "é", "\u00b2", "\ud800",
        f"open({str(harm)!r}, 'w')", f"__import__('os').mkdir({str(harm)!r})", "9" * 400,
    ]  # fmt: skip
    refused = 0
    for _ in range(1500):
        words = [pieces[i] for i in rng.integers(len(pieces), size=rng.integers(1, 12))]
        try:
            text = rng.choice(["", " "]).join(words)
            assert Space(MEMBERS, constraints={"wall": text}).violations(PARAMS)["wall"] >= 0
        except SpaceError:
            refused += 1
    assert refused > 1000 and not harm.exists()


def test_a_space_keeps_its_constraints_in_every_form() -> None:
    texts = {"wall": "inner < 0.6 * outer", "lid": 'floor == "wood" or lid'}
    space = Space(MEMBERS, constraints=texts)
    for other in (
        Space.from_dict(space.to_dict()),
        pickle.loads(pickle.dumps(space)),
    ):
        assert other == space and hash(other) == hash(space) and other.constraints == texts
        assert other.violations(PARAMS) == pytest.approx({"wall": 0.06, "lid": 0.0})
    without = Space(MEMBERS)
    assert space != without and without.constraints == {}
    assert "constraints" not in without.to_dict()


@pytest.mark.parametrize(
    "make",
    [
        lambda: Space(constraints=Float(0, 1)),
        lambda: Space({"constraints": Float(0, 1)}),
        lambda: Space.from_toml('[constraints]\ntype = "float"\nlow = 0\nhigh = 1\n'),
        lambda: Space.from_toml(
            '[constraints]\n[constraints.x]\ntype = "float"\nlow = 0\nhigh = 1\n'
        ),
        lambda: Space.from_toml('constraints = [1]\n[x]\ntype = "float"\nlow = 0\nhigh = 1\n'),
    ],
)
def test_no_parameter_may_be_called_constraints(make: Callable[[], Space]) -> None:
    with pytest.raises(SpaceError, match="no parameter may be called 'constraints'"):
        make()


@pytest.mark.parametrize("text", [["inner < 1"], 1, None])
def test_a_constraint_must_be_a_text(text: Any) -> None:
    with pytest.raises(SpaceError, match="constraint wall = .* it must be a text"):
        Space(MEMBERS, constraints={"wall": text})


def test_a_file_names_the_constraint_that_is_wrong(tmp_path: Path) -> None:
    path = tmp_path / "space.toml"
    path.write_text('[x]\ntype = "float"\nlow = 0\nhigh = 1\n[constraints]\nwall = "x < y"\n')
    with pytest.raises(SpaceError, match="space.toml: constraint wall = 'x < y': unknown"):
        Space.read(path)
