"""Values in their units, with standard deviations."""

from __future__ import annotations

import numpy as np
import pytest

from fide_plugins import Choice, Float, Group, Int, Solution, Space
from fide_plugins.recording.parameters import described, lines, rows
from fide_plugins.types import Estimated


def solution(x: object, std: object = None, space: Space | None = None) -> Solution:
    estimate = Estimated(None if std is None else np.asarray(std, np.float64))
    return Solution(np.asarray(x, np.float64), 0.5, 3, space=space, estimate=estimate)


def test_standard_deviations_are_in_the_units_of_the_parameters() -> None:
    space = Space(
        sun=Float(-50, 50, unit="deg"), rough=Float(0.01, 1, log=True), rows=Int(1, 4),
        floor=Choice("a", "b", "c"), ball=Group(x=Float(0, 2, unit="m")),
    )  # fmt: skip
    x = space.encode({"sun": 0, "rough": 0.1, "rows": 3, "floor": "b", "ball": {"x": 1}})
    std = np.array([0.01, 0.1, 0.05, 0.01, 0.01, 0.01, 0.25])
    table = {row.label: row for row in rows([solution(x, std, space), solution(x, None, space)])}
    assert table["sun [deg]"].values == ["0.0 ± 1.0", "0"]
    assert table["rough"].values == ["0.100 ± 0.046", "0.1"]  # 0.1 * ln(100) * 0.1
    assert table["rows"].values == ["3 ± 0.20", "3"]
    assert table["floor"].values == ["b", "b"]
    assert table["ball.x [m]"].values == ["1.00 ± 0.50", "1"]
    assert [row.label for row in table.values() if not row.determined] == ["ball.x [m]"]


def test_a_line_and_lines_have_units() -> None:
    space = Space(sun=Float(-50, 50, unit="deg"), ball=2 * Group(x=Float(0, 2, unit="m")))
    one = solution(space.encode({"sun": 0, "ball": [{"x": 1}, {"x": 1.5}]}), [0.01] * 3, space)
    sun, first, second = "0.0 ± 1.0 deg", "1.000 ± 0.020 m", "1.500 ± 0.020 m"
    assert described(one) == f"sun={sun}, ball[0].x={first}, ball[1].x={second}"
    assert lines(one, 2) == [f"sun        {sun}", f"ball[0].x  {first}", "... 1 more"]
    assert lines(one, 3)[2] == f"ball[1].x  {second}"


def test_the_deviation_of_a_logarithm_is_that_of_its_samples() -> None:
    space = Space(rough=Float(0.01, 1, log=True))
    x = np.array([0.5])
    (row,) = rows([solution(x, [0.01], space)])
    sample = 0.5 + 0.01 * np.random.default_rng(0).normal(size=4000)
    values = [space.decode([one])["rough"] for one in sample]
    assert float(row.values[0].split("±")[1]) == pytest.approx(np.std(values), rel=0.05)


def test_without_a_space_coordinates_are_numbered() -> None:
    (first, second) = rows([solution([0.25, 0.5], [0.1, 0.28])])
    assert (first.name, first.values, first.determined) == ("x[0]", ["0.25 ± 0.10"], True)
    assert (second.name, second.determined) == ("x[1]", False)


def test_an_integer_has_no_deviation_and_is_not_open_for_that() -> None:
    (row,) = rows([solution([0.5], [np.nan], Space(rows=Int(1, 3)))])
    assert (row.values, row.determined) == (["2"], True)


@pytest.mark.parametrize(
    ("x", "std", "text"),
    [
        (0.32, 0.001, "3.200e-10 ± 1.0e-12"),
        (0.32, 0.5, "3.2e-10 ± 5.0e-10"),
        (0.0, 0.001, "0 ± 1.0e-12"),
        (0.32, 0.0, "3.200e-10 ± 0.0000"),
    ],
)
def test_small_units_have_exponents(x: float, std: float, text: str) -> None:
    (row,) = rows([solution([x], [std], Space(x=Float(0, 1e-9, unit="m")))])
    assert row.values == [text]
