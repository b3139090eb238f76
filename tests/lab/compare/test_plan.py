"""Plans: words for optimizers, names for files, what is refused before anything runs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, strategies as st

from fide_lab.compare import Configuration, Plan, RunKey
from fide_lab.compare.plan import as_file_name
from fide_plugins.errors import OptionError, UnknownNameError

from .conftest import small

parse = Configuration.parse


@pytest.mark.parametrize(
    ("text", "label", "name", "options", "budget"),
    [
        ("cma", "cma", "cma", {}, None),
        ("cma:popsize=50", "cma:popsize=50", "cma", {"popsize": 50}, None),
        ("cma:b=x:a=0.5", "cma:a=0.5:b=x", "cma", {"a": 0.5, "b": "x"}, None),
        ("nevergrad:CMA", "nevergrad:CMA", "nevergrad:CMA", {}, None),
        ("optuna:TPESampler:k=true", "optuna:TPESampler:k=True", "optuna:TPESampler", {"k": True},
         None),
        ("dibo:budget=2000", "dibo:budget=2000", "dibo", {}, 2000),
    ],
)  # fmt: skip
def test_configurations(
    text: str, label: str, name: str, options: dict[str, Any], budget: int
) -> None:
    configuration = parse(text)
    assert (
        configuration.label,
        configuration.name,
        configuration.options,
        configuration.budget,
    ) == (label, name, options, budget)
    assert parse(configuration.label) == configuration


@pytest.mark.parametrize(
    "text", ["", "popsize=3", "cma:a=1:a=2", "cma:=3", "dibo:budget=0", "dibo:budget=many"]
)
def test_impossible_configurations(text: str) -> None:
    with pytest.raises(OptionError):
        parse(text)


@given(st.text(), st.text())
def test_different_texts_have_different_file_names(a: str, b: str) -> None:
    names = []
    for text in (a, b):
        try:
            names.append(as_file_name(text))
        except UnicodeEncodeError:
            return
    assert (names[0] == names[1]) == (a == b)
    for name in names:
        assert re.fullmatch(r"[A-Za-z0-9._~=%+-]*", name) and not name.startswith(".")


def test_runs_go_by_seeds_so_that_pairs_come_together() -> None:
    plan = small(tasks=("voronoi", "spline"), losses=("mse", "loi"))
    runs = list(plan.runs())
    assert len(runs) == len(set(runs)) == 2 * 2 * 2 * 2
    assert [key.seed for key in runs] == [0] * 8 + [1] * 8
    assert runs[1] == RunKey("voronoi", "mse", "random", 0)
    assert str(runs[1].folder) == "cells/voronoi/mse/random/seed-0"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tasks": ()}, "at least one task"),
        ({"configurations": ()}, "at least one optimizer"),
        ({"losses": ("mse", "mse")}, "the loss 'mse' is named twice"),
        (
            {
                "configurations": (
                    Configuration.parse("cma:b=1:a=2"),
                    Configuration.parse("cma:a=2:b=1"),
                )
            },
            "named twice",
        ),
        ({"seeds": 0}, "seeds must be"),
        ({"budget": 0}, "budget must be"),
    ],
)
def test_impossible_plans(changes: dict[str, Any], message: str) -> None:
    settings: dict[str, Any] = {
        "tasks": ("voronoi",),
        "configurations": (Configuration.parse("cma"),),
        **changes,
    }
    with pytest.raises(OptionError, match=message):
        Plan(**settings)


@pytest.mark.parametrize(
    ("plan", "error", "message"),
    [
        (small(tasks=("vornoi",)), ValueError, "no task is named 'vornoi'; the tasks: .*voronoi"),
        (small("cmaa"), UnknownNameError, "unknown optimizer 'cmaa'.*did you mean 'cma'"),
        (small(losses=("msee",)), UnknownNameError, "unknown loss 'msee'.*did you mean 'mse'"),
        (small(metrics=("l3",)), UnknownNameError, "unknown loss 'l3'"),
        (small("cma:epochs=3"), OptionError, "cma has no option 'epochs'; its options: device"),
        (
            small("cma", options={"epochs": 3}),
            OptionError,
            "one optimizer only, as NAME:epochs=3",
        ),
        (small("cma", options={"seed": 3}), OptionError, "seed is a setting of the comparison"),
        (small(task_options={"colour": 1}), ValueError, "voronoi has no option 'colour'"),
    ],
)
def test_what_cannot_be_run_is_named(
    plan: Plan, error: type[Exception], message: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=message):
        plan.check(tmp_path)


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        (small("cma", budget=5), "budget of 5 renders is below one population of cma, which is 10"),
        (small("cma:budget=5"), "below one population of cma:budget=5, which is 10 for 10 param"),
        (small("cma:popsize=41"), "which is 41 for 10 parameters: the optimizer never learns"),
    ],
)
def test_a_budget_below_one_population_gets_a_warning(
    plan: Plan, message: str, tmp_path: Path
) -> None:
    with pytest.warns(RuntimeWarning, match=message):
        assert set(plan.check(tmp_path).settings) == set(plan.runs())


def test_everyone_of_a_task_has_the_same_target(tmp_path: Path) -> None:
    plan = small("cma", "random", "cma:popsize=20", tasks=("voronoi",), losses=("mse", "loi"))
    checked = plan.check(tmp_path)
    assert list(checked.settings) == list(plan.runs())
    assert len({run["target"] for run in checked.settings.values()}) == 1
    assert {run["budget"] for run in checked.settings.values()} == {40}
    for key, run in checked.settings.items():
        assert (run["loss"], run["seed"]) == (key.loss, key.seed)
        assert run["options"] == ({"popsize": 20} if "=" in key.configuration else {})
