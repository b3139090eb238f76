"""What a report says in words."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fide_plugins.learning.judging import Report, split_held_out
from fide_plugins.learning.training import is_held_out

REPORT = Report(
    renders=980, failed=0, held_out=20, seconds=3.0, nll=-1.25, within=(0.4, 0.75), coverage=0.9,
    ranks=(0.9,) * 4, unseen=(), curve=((1.0, -1.0, -1.0),), augment="photograph", scale=1.0,
    fitted=0, parameters=4, emulated=None,
)  # fmt: skip
NEAR = (
    "one of 64 hypotheses is within 0.05 of the box in 40% +- 11%, within 0.1 in 75% +- 10% of "
    "20 pictures"
)
RIGHT = "of pictures (90 % is right, +- 7% by chance)"
SINGLE = "the truth is between the 5 % and the 95 % quantile of a parameter's samples in "
WHY = "the images do not show them, or it takes more renders or passes"


def lines(report: Report) -> list[str]:
    return str(report).splitlines()


def test_all_parameters_are_shown() -> None:
    assert lines(REPORT)[1:] == [
        "1.25 nats better than the uniform prior on 20 held-out renders",
        NEAR,
        "90 % regions hold the truth in 90% +- 8% of 20 pictures",
        f"{SINGLE}90% {RIGHT}",
        "not calibrated: that takes 5,000 renders",
    ]


def test_shares_are_of_the_pictures_that_judged() -> None:
    """Others chose the scale, and more than 300 are not drawn from."""
    report = replace(REPORT, held_out=2000, fitted=300, coverage=1.0)
    assert "on 1,700 held-out renders" in str(report)
    assert "hold the truth in 100% +- 0% of 300 pictures" in str(report)
    assert "calibrated by 300 other held-out renders: standard deviations times 1.00" in str(report)
    few = replace(REPORT, held_out=6, coverage=1.0)
    assert "hold the truth in 100% +- 14% of 6 pictures" in str(few)  # 0 % would seem to be sure


def test_so_many_renders_are_calibrated() -> None:
    for renders, fitted in ((4900, 0), (5000, 50)):
        fit, judges = split_held_out(is_held_out(renders))
        assert fit.sum() == fitted and fit.sum() + judges.sum() == renders // 50


def test_renders_that_failed_are_told() -> None:
    line = "289 renders failed and were left out: the model knows nothing there"
    assert lines(replace(REPORT, failed=289))[1] == line
    assert "1 render failed and was left out" in str(replace(REPORT, failed=1))
    assert "failed" not in str(REPORT)


def test_calibration_of_parameters_is_said_but_for_blocks() -> None:
    some = replace(REPORT, ranks=(0.82, 0.95, float("nan"), 0.9))
    assert f"{SINGLE}82% to 95% {RIGHT}" in lines(some)
    blocks = replace(REPORT, ranks=(float("nan"),) * 4)
    assert "quantile" not in str(blocks)


def test_several_passes_are_a_curve() -> None:
    curve = ((98.0, -1.0, -0.5), (196.0, -2.0, -1.25))
    report = lines(replace(REPORT, curve=curve))
    assert "nats after each pass: 0.50, 1.25" in report
    assert report[1].endswith("on 20 held-out renders, which also chose the pass")
    assert "after each pass" not in str(REPORT)


def test_a_share_says_of_which_parameters_it_is() -> None:
    report = replace(REPORT, unseen=("dust", "fog"))
    assert lines(report)[2:4] == [
        f"{NEAR}, in the 2 of 4 parameters that the images show",
        f"nothing was learned of dust, fog: {WHY}",
    ]


def test_axes_of_a_choice_are_one_parameter() -> None:
    report = replace(REPORT, unseen=("floor",), parameters=2)
    assert "in the 1 of 2 parameters" in str(report)
    assert "nothing was learned of floor: the images do not show it, or it takes" in str(report)


def test_there_is_no_share_where_nothing_was_learned() -> None:
    report = replace(REPORT, unseen=("x", "y", "z", "gray"), within=(1.0, 1.0))
    assert "hypotheses" not in str(report) and "100%" not in str(report)
    assert lines(report)[2] == f"nothing was learned of any of the 4 parameters: {WHY}"


def test_a_model_below_the_prior_is_worse() -> None:
    assert "0.44 nats worse than the uniform prior" in str(replace(REPORT, nll=0.44))


@pytest.mark.parametrize(
    ("share", "said", "used"),
    [
        (0.997, "99.7%", True), (0.9, "90.0%", True), (0.8996, "90.0%", True),
        (0.8994, "89.9%", False), (0.1, "10.0%", False), (-3.0, "0.0%", False),
    ],
)  # fmt: skip
def test_a_report_says_whether_the_emulator_is_used(share: float, said: str, used: bool) -> None:
    """By the number that it prints."""
    report = replace(REPORT, emulated=share)
    what = "it refines hypotheses" if used else "too little to be used"
    line = f"the emulator explains {said} of the variance of held-out renders: {what}"
    assert lines(report)[-1] == line
    assert report.emulates == used


def test_without_an_emulator_none_is_used() -> None:
    assert not REPORT.emulates and "emulator" not in str(REPORT)
