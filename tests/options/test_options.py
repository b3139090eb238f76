"""What can be set, and how a mistake is told."""

from __future__ import annotations

from dataclasses import asdict, fields
from typing import Any

import pytest

from fide_plugins.errors import OptionError, UnknownNameError
from fide_plugins.options import (
    PRESETS,
    Options,
    check_known,
    make_options,
    without_images,
)


def test_the_paper_s_values() -> None:
    """Supplement S1 of the paper."""
    paper = PRESETS["paper"]
    assert paper.encoder == "patch"
    assert paper.popsize == 500
    assert paper.proposer == "diffusion"
    assert (paper.proposal_fraction, paper.fraction_rate) == (0.5, 0.0)
    assert (paper.epochs, paper.learning_rate) == (20, 1e-3)
    assert paper.schedule == (0.3, 0.2, 0.1)
    assert not paper.guard_search
    assert paper.restarts == "none"


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_every_preset_passes_its_own_checks(preset: str) -> None:
    given = asdict(PRESETS[preset])
    assert make_options("fast", {**given, "popsize": None}) is not None
    assert make_options(preset, given) == PRESETS[preset]


def test_none_leaves_what_the_preset_has_where_it_is_no_value() -> None:
    nothing: dict[str, Any] = dict.fromkeys(asdict(PRESETS["paper"]))
    del nothing["coarse_to_fine"]  # of which None is a value
    assert make_options("paper", nothing) == PRESETS["paper"]


def test_changes_replace_the_preset_s() -> None:
    options = make_options("paper", {"popsize": 20, "epochs": 3, "schedule": [0.5, 0.25]})
    assert (options.popsize, options.epochs) == (20, 3)
    assert options.schedule == (0.5, 0.25)
    assert options.encoder == "patch"
    assert PRESETS["paper"].popsize == 500


def test_every_option_is_documented() -> None:
    for field in fields(Options):
        assert field.name in (Options.__doc__ or ""), field.name


def test_a_search_that_sees_no_image_has_no_options_of_a_network() -> None:
    given = {"epochs": 5, "popsize": 8, "buffer_generations": 5}
    kept = {"popsize": 8, "buffer_generations": 5, "proposer": "none", "encoder": "dense"}
    assert without_images(given) == kept
    make_options("paper", without_images({"epochs": 5}))


def test_an_unknown_option_is_told_with_those_that_are_known() -> None:
    for name in ("x0", "learned"):
        with pytest.raises(OptionError, match=f"^{name} is an argument of FIDE itself, not one of"):
            make_options("balanced", {name: 1})
    with pytest.raises(OptionError, match="no option 'sahre'") as caught:
        make_options("balanced", {"sahre": 0.3})
    assert all(field.name in str(caught.value) for field in fields(Options))
    with pytest.raises(OptionError) as caught:
        check_known({"sahre": 0.3}, "fit", ["target", "mask", "seed", "learned", "sigma0"])
    named = str(caught.value).rpartition("known are ")[2].split(", ")
    assert len(named) == len(set(named))
    with pytest.raises(OptionError, match=r"'pop_size' \(did you mean 'popsize'\?\)"):
        make_options("balanced", {"pop_size": 8})


def test_unknown_names() -> None:
    with pytest.raises(UnknownNameError, match="'balancd'.*did you mean 'balanced'"):
        make_options("balancd", {})
    with pytest.raises(UnknownNameError):
        make_options(["fast"], {})  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="no option 'populationsize'.*popsize"):
        make_options("fast", {"populationsize": 3})


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("popsize", [3, 0, -1, 4.5, "many", True, float("nan")]),
        ("buffer_generations", [0, 1.5]),
        ("epochs", [0, -3]),
        ("batch_size", [0]),
        ("patience", [0]),
        ("proposal_fraction", [-0.1, 1.1, float("nan"), "half", True]),
        ("fraction_rate", [-1, 2]),
        ("improvement", [-0.1, 1.1, float("nan")]),
        ("learning_rate", [0, -1e-3]),
        ("proposer", ["linaer", 3, "", ["linear"]]),
        ("restarts", ["always", True]),
        ("guard_search", [1, "yes"]),
        ("schedule", [[], [0.1, 0.2], "steep", [float("nan")], 0.3, [0.3, -0.1]]),
        ("encoder", [3, ["dense"]]),
        ("channel_subsets", [0, [0, 3], 2.5, "colors"]),
    ],
)
def test_a_wrong_value_is_named_with_its_rule(name: str, values: list[Any]) -> None:
    for value in values:
        with pytest.raises(OptionError, match=name) as caught:
            make_options("balanced", {name: value})
        assert isinstance(caught.value, ValueError)
        shown = str(value[0]) if isinstance(value, list) and value else str(value)
        assert shown in str(caught.value), value


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("epochs", 50),
        ("schedule", (0.2, 0.1)),
        ("batch_size", 10),
        ("learning_rate", 0.1),
    ],
)
def test_what_is_of_the_network_goes_with_a_network(name: str, value: Any) -> None:
    for preset in ("fast", "balanced", "accurate"):
        proposer = PRESETS[preset].proposer
        with pytest.raises(OptionError, match=f"{name}=.*of the network.*'{proposer}' has none"):
            make_options(preset, {name: value})
        options = make_options(preset, {name: value, "proposer": "diffusion"})
        assert getattr(options, name) == value
    assert getattr(make_options("paper", {name: value}), name) == value


def test_a_schedule_has_an_end() -> None:
    with pytest.raises(OptionError, match="at most 1,000, not 1,001"):
        make_options("paper", {"schedule": [1 / n for n in range(1, 1002)]})
