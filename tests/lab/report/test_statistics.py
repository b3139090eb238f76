"""Statistics against numbers worked out by hand and against SciPy."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import stats

from fide_lab.report import statistics
from fide_lab.report.panel import panels
from fide_lab.report.statistics import adjusted, bands, paired, quantiles

from .conftest import curve, failed, missing, result, results

pytestmark = pytest.mark.figures


def test_a_curve_is_a_step_function() -> None:
    c = curve([2, 5, 9], [3.0, 2.0, 1.0], 20)
    values = c.value("renders", [1, 2, 4, 5, 8.9, 9, 20, 99])
    np.testing.assert_array_equal(values, [np.nan, 3, 3, 2, 2, 1, 1, 1])
    assert c.value("seconds", [0.5])[0] == 2.0
    assert [c.reaches("renders", loss) for loss in (3, 2.5, 2, 0.5)] == [2, 5, 5, np.inf]


def test_bands_are_quantiles_of_the_best_loss_at_each_number_of_renders() -> None:
    rng = np.random.default_rng(0)
    losses = rng.lognormal(size=(7, 50))
    best = np.minimum.accumulate(losses, axis=1)
    curves = []
    for row in best:
        falls = np.flatnonzero(np.diff(row, prepend=np.inf) < 0)
        curves.append(curve((falls + 1).tolist(), row[falls].tolist(), 50))
    found = bands(curves, "renders")
    assert found.x[0] == 1 and found.x[-1] == 50 and (np.diff(found.x) > 0).all()
    expected = np.quantile(best[:, found.x.astype(int) - 1], statistics.QUANTILES, axis=0)
    np.testing.assert_allclose(found.values, expected)


def test_a_band_begins_where_all_have_begun_and_ends_with_the_median_run() -> None:
    early, late = curve([1, 3], [1.0, 0.5], 10), curve([4], [0.7], 30)
    found = bands([early, late, late], "seconds")
    assert found.x[0] == pytest.approx(0.4) and found.x[-1] == pytest.approx(3.0)
    assert found.values[2].tolist() == [0.7] * len(found.x)
    assert len(bands([curve([], [], 10)], "renders").x) == 0


def test_quantiles_take_infinity_for_the_highest_value() -> None:
    np.testing.assert_array_equal(quantiles([1, 2, np.inf], [0, 0.5, 1]), [1, 2, np.inf])
    np.testing.assert_array_equal(quantiles([1, np.inf, np.inf], [0.5]), [np.inf])
    np.testing.assert_array_equal(quantiles([1, 3, np.inf, np.inf], [0.5]), [np.inf])


def test_the_rank_test_is_scipy_s_of_logarithms() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.lognormal(size=(2, 10))
    found = paired(a, b)
    assert found.p == stats.wilcoxon(np.log(a / b)).pvalue
    assert found.worse == (a > b).sum() and found.ratio == pytest.approx(np.median(a / b))


def by_all_signs(differences: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    """The two-sided p of the signed-rank test from its definition."""
    ranks = stats.rankdata(np.abs(differences))
    seen = abs((ranks * np.sign(differences)).sum())
    signs = itertools.product((-1, 1), repeat=len(differences))
    size = ranks * (differences != 0)
    return float(np.mean([abs((size * s).sum()) >= seen - 1e-9 for s in signs]))


LEVELS = st.sampled_from([0.5, 1.0, 1.5, 2.0, 4.0])


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(LEVELS, LEVELS), min_size=2, max_size=7))
def test_ties_and_zeros_are_exact_too(pairs: list[tuple[float, float]]) -> None:
    a, b = np.array(pairs).T
    found = paired(a, b)
    assert found.p == pytest.approx(by_all_signs(np.log(a) - np.log(b)), abs=1e-9)
    mirrored = paired(b, a)
    assert mirrored.p == pytest.approx(found.p)


def test_equal_losses_are_no_difference() -> None:
    found = paired([1.0, 2.0], [1.0, 2.0])
    assert (found.p, found.ratio, found.worse) == (1.0, 1.0, 0)


def test_zero_and_infinite_losses() -> None:
    found = paired([0.0, 0.2, 0.3], [0.1, 0.4, 0.8])
    assert found.worse == 0 and np.isnan(found.ratio)
    assert paired([np.inf, 5.0, np.inf], [1.0, 2.0, 3.0]).worse == 3
    assert paired([np.inf], [np.inf]).p == 1.0


def test_negative_losses_are_compared_themselves() -> None:
    found = paired([-1.0, -5.0, 2.0], [-2.0, -3.0, 2.5])  # differences 1, -2, -0.5
    assert found.worse == 1


def test_adjusting_is_benjamini_and_hochberg_s() -> None:
    assert adjusted([]) == []
    assert adjusted([0.01, 0.02, 0.9]) == pytest.approx([0.03, 0.03, 0.9])


def test_a_panel_says_who_won_and_how_surely() -> None:
    good, bad = [0.1 * 1.01**s for s in range(8)], [0.2 * 1.03**s for s in range(8)]
    runs = [result("good", s, v) for s, v in enumerate(good)]
    runs += [result("bad", s, v) for s, v in enumerate(bad)]
    runs += [result("same", s, v * (1.001 if s % 2 else 1 / 1.0015)) for s, v in enumerate(good)]
    (panel,) = panels(results(runs), {})
    assert [row.label for row in panel.lowest] == ["same"]
    rows = {row.label: row for row in panel.rows}
    assert panel.significant(rows["bad"]) and not panel.significant(rows["good"])
    tests = panel.against_winner
    assert tests["bad"].p == pytest.approx(2**-7) and tests["bad"].adjusted == pytest.approx(2**-6)
    assert panel.threshold == rows["good"].median and not panel.stated
    assert panel.reached(rows["bad"]) == 0 and panel.to_target(rows["bad"]) == np.inf
    assert panel.reached(rows["good"]) == 4


def test_success_is_judged_without_noise() -> None:
    unlucky, lucky, both, none = (result("a", s, v) for s, v in enumerate([0.1, 0.3, 0.1, 0.3]))
    for run, told in ((unlucky, 0.25), (lucky, 0.15), (both, 0.15), (none, 0.25)):
        assert run.curve is not None
        run.curve.loss[-1] = told
    (panel,) = panels(results([unlucky, lucky, both, none]), {"mse": 0.2})
    reached = [panel.renders_to_target(run) for run in panel.rows[0].runs]
    assert reached == [10, np.inf, 10, np.inf] and panel.reached(panel.rows[0]) == 2
    assert both.curve is not None
    both.curve.at["renders"][-1] = 4  # told so earlier than the best was found
    assert panel.renders_to_target(both) == 4


def test_runs_of_other_budgets_are_compared_where_the_shorter_ends() -> None:
    long = [result("long", s, 0.01) for s in range(6)]
    short = [result("short", s, 0.5, end=8) for s in range(6)]  # it never came to its 10th render
    for run in short:
        assert run.curve is not None
        run.curve.loss[:] = run.curve.loss[0] * 0.9
    (panel,) = panels(results([*long, *short]), {})
    assert [row.label for row in panel.lowest] == ["long"]
    assert panel.against_winner["short"].worse == 0, "at 8 renders the short one was ahead"


def test_pairs_are_runs_of_one_seed_and_the_missing_are_left_out() -> None:
    runs = [result("a", s, 0.1 + s) for s in range(4)] + [result("b", s, 1.0 + s) for s in (1, 3)]
    (panel,) = panels(results(runs), {})
    assert panel.against_winner[next(iter(panel.against_winner))].n == 2


def test_no_optimizer_gains_by_failing() -> None:
    """One that fails wherever it would be bad is no better than the same one without failures."""
    finals = [0.1 + s / 100 for s in range(10)]
    runs = [result("plain", s, v) for s, v in enumerate(finals)]
    lucky = [result("lucky", s, v) if v < 0.135 else failed("lucky", s)
             for s, v in enumerate(finals)]  # fmt: skip
    (panel,) = panels(results([*runs, *lucky]), {})
    rows = {row.label: row for row in panel.rows}
    assert [row.label for row in panel.lowest] == ["plain"]
    assert rows["lucky"].median == np.inf and rows["lucky"].planned == 10
    assert panel.threshold == np.inf, "no second median is finite"
    (panel,) = panels(results([*runs, *lucky]), {"mse": 0.125})
    assert panel.reached(rows["lucky"]) == panel.reached(rows["plain"]) == 3
    assert panel.to_target(rows["lucky"]) == np.inf
    test = panel.against_winner["lucky"]
    assert test.n == 10 and test.worse == 6


def test_an_optimizer_without_a_finished_run_is_listed_and_compared() -> None:
    runs = [result("a", s, 0.1 + s / 100) for s in range(6)]
    runs += [*(failed("b", s) for s in range(6)), *(missing("c", s) for s in range(6))]
    (panel,) = panels(results(runs), {})
    assert [row.label for row in panel.every] == ["a", "b", "c"]
    assert [row.label for row in panel.rows] == ["a"]
    assert panel.significant(panel.every[1]) and set(panel.against_winner) == {"b"}
    assert panel.against_winner["b"].ratio == np.inf
