"""Profiles and scores of curves that were made by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fide_lab.compare.plan import RunKey
from fide_lab.compare.results import Curve, NoResultsError, Results, StoredRun
from fide_lab.suite.page import by_scene, lowest, sign_test, totals
from fide_lab.suite.scores import data_profile, scores

INF = np.inf
T = np.array([[10, 20], [INF, 30], [INF, INF], [40, 40.0]])


def test_data_profile() -> None:
    shares = data_profile(T, [9, 10, 20, 30, 40, 1e9])
    np.testing.assert_array_equal(shares[:, 0], [0, 0.25, 0.25, 0.25, 0.5, 0.5])
    np.testing.assert_array_equal(shares[:, 1], [0, 0, 0.25, 0.5, 0.75, 0.75])


def test_no_problems() -> None:
    with pytest.raises(ValueError, match="at least one problem"):
        data_profile(np.empty((0, 2)), [1])


def results(curves: dict[tuple[str, str], list[tuple[int, float]] | None], budget: int) -> Results:
    """Results of problems and optimizers: (renders, loss) of each improvement; None: unfinished."""
    runs = []
    for (problem, label), steps in curves.items():
        key = RunKey(problem, "mse", label, 0)
        if steps is None:
            runs.append(StoredRun(key, Path(), "missing"))
            continue
        at, loss = np.array(steps, np.float64).reshape(-1, 2).T
        curve = Curve({"renders": at}, {"renders": budget}, loss, {})
        runs.append(StoredRun(key, Path(), "finished", curve=curve))
    settings = {"task_options": {"suite": "image-fitting-v1"}, "budget": budget}
    return Results(Path("here"), settings, [], {}, {}, runs)


CURVES: dict[tuple[str, str], list[tuple[int, float]] | None] = {
    ("lamps-0", "a"): [(1, 0.1), (400, 1e-5), (900, 1e-9)],  # solved at 1e-5, by equality
    ("lamps-0", "b"): [(1, 0.1), (700, 1e-4), (2001, 1e-6)],
    ("voronoi-0", "a"): [(3, 0.1)],
    ("voronoi-0", "b"): [(500, 9e-4)],
    ("lamps-1", "a"): [(5, 1e-7)],
    ("lamps-1", "b"): None,
}


def test_scores_of_curves() -> None:
    found = scores(results(CURVES, 10_000))
    assert found.problems == ("lamps-0", "voronoi-0")
    assert (found.labels, found.budgets) == (("a", "b"), (500, 2000, 10_000))
    np.testing.assert_array_equal(found.t, [[400, 2001], [INF, 500]])
    np.testing.assert_array_equal(found.losses[0], [[1e-5, 0.1], [0.1, 9e-4]])
    np.testing.assert_array_equal(found.losses[2], [[1e-9, 1e-6], [0.1, 9e-4]])
    assert found.scenes == ["voronoi", "lamps"]
    cells = [list(row) for row in by_scene(found, ["a", "b"]).rows]
    assert cells == [["voronoi", "1", "0 / 0 / 0", "1 / 1 / 1"],
                     ["lamps", "1", "1 / 1 / 1", "0 / 0 / 1"]]  # fmt: skip
    counts = [row[1::2] for row in totals(found, ["a", "b"]).rows]
    assert counts == [["1", "1", "1"], ["1", "1", "2"]]


def test_a_smaller_budget_is_the_last_mark() -> None:
    assert scores(results(CURVES, 600)).budgets == (500, 600)
    assert scores(results(CURVES, 60)).budgets == (60,)


def test_nothing_to_show() -> None:
    some: dict[tuple[str, str], list[tuple[int, float]] | None]
    some = {("lamps-0", "a"): [(1, 0.1)], ("lamps-0", "b"): None}
    with pytest.raises(NoResultsError, match="no problem in here is finished by all"):
        scores(results(some, 100))


def test_losses_below_the_threshold_are_equal() -> None:
    found = scores(results(CURVES, 10_000))
    cells = [row[1::2] for row in lowest(found, ["a", "b"]).rows]
    assert cells == [["1", "1", "1"], ["1", "1", "2"]]  # at the end both have solved lamps-0


def test_a_failed_run_has_no_lowest_loss() -> None:
    curves: dict[tuple[str, str], list[tuple[int, float]] | None]
    curves = {(f"lamps-{k}", label): [(1, 0.1)] for k in range(4) for label in "ab"}
    curves["lamps-0", "b"] = [(1, 0.2)]
    found = scores(results(curves, 500))
    losses = found.losses.copy()
    losses[:, 2] = np.inf  # both failed
    losses[:, 3, 1] = np.inf  # b failed
    table = lowest(replace(found, losses=losses), ["a", "b"])
    assert table.caption.endswith("of 4")
    assert [row[1] for row in table.rows] == ["3", "1"]
    assert table.rows[1][2] == "0.5 (2 : 0)"  # of the two pairs that differ


def test_who_is_beaten_by_a_rival_pair_by_pair_is_seen_to_be() -> None:
    """Of three "a" has the lowest loss most often, and yet a higher one than "b" on 12 of 20."""
    curves: dict[tuple[str, str], list[tuple[int, float]] | None]
    curves = {(f"lamps-{k}", label): [(1, 0.1)] for k in range(2) for label in "abc"}
    found = scores(results(curves, 500))
    losses = np.empty((1, 20, 3))
    losses[0, :8] = [0.1, 0.2, 0.3]
    losses[0, 8:14] = [0.3, 0.1, 0.2]
    losses[0, 14:] = [0.3, 0.2, 0.1]
    found = replace(found, problems=tuple(f"lamps-{k % 10}" for k in range(20)), losses=losses)
    rows = lowest(found, ["a", "b", "c"]).rows
    assert [row[1] for row in rows] == ["8", "6", "6"]
    assert [row[2].partition(" ")[2] for row in rows] == ["", "(8 : 12)", "(8 : 12)"]


def test_p_of_a_sign_test_is_that_of_the_pairs_that_differ() -> None:
    a, b = np.array([1, 1, 1, 1, 1, 1, 0, 1.0]), np.array([0, 0, 0, 0, 0, 0, 0, 1.0])
    assert sign_test(a, b) == sign_test(b, a) == pytest.approx(2 * 0.5**6)
    assert sign_test(a, a) == 1.0
    assert sign_test(-a, -np.full(8, np.inf)) == pytest.approx(2 * 0.5**8)
