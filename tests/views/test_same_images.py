"""A renderer that does not use its parameters is noticed, and no other one."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from fide_plugins import FIDE, Float, Int, Space, fit
from fide_plugins.views.findings import SameImages

SPACE = Space(x=Float(0, 1), y=Float(0, 1), n=Int(1, 5))
TARGET = np.linspace(0, 1, 64).reshape(8, 8)
SAYS = (
    "all images of the first 32 candidates are equal: .* does render use its parameters.*"
    r" \(These candidates lie around the start of the search: elsewhere .* images may differ\.\)"
)


def constant(p: dict[str, Any]) -> Any:
    return TARGET * 0.5


def test_a_fit_says_once_that_all_images_are_equal() -> None:
    with pytest.warns(RuntimeWarning, match=SAYS) as seen:
        result = fit(constant, TARGET, SPACE, 60, workers=0, seed=0)
    assert len(seen) == 1 and seen[0].filename == __file__
    assert result.status.code == "stalled" and result.evaluations == 60
    assert "candidates have the same image" in result.status.sentence


@pytest.mark.parametrize(("noise", "equal"), [(1e-7, True), (1e-4, False)])
def test_a_gpu_s_rounding_makes_no_image_another_one(noise: float, equal: bool) -> None:
    generator = np.random.default_rng(0)
    opt = FIDE(SPACE, TARGET, seed=0)
    images = [TARGET * 0.5 + 0.1 + generator.normal(0, noise, (8, 8)) for _ in range(40)]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        opt.tell(opt.ask(40), images)
    assert [one.category for one in said] == [RuntimeWarning] * equal
    assert opt.status.sentence.startswith("All 40 candidates") == equal


def test_what_only_a_part_of_the_box_shows_is_taken_back_when_it_is_seen() -> None:
    opt = FIDE(SPACE, TARGET, seed=0)
    X = opt.ask(32)
    with pytest.warns(RuntimeWarning, match=SAYS):
        opt.tell(X, [TARGET * 0.5] * 32)
    opt.tell(np.array([[0.99, 0.5, 0.5]]), [TARGET * 0.7])
    assert opt.status.code == "improving"


def test_after_candidates_without_images_nothing_is_said() -> None:
    opt = FIDE(SPACE, TARGET, seed=0)
    with pytest.warns(RuntimeWarning, match="all images of the first 40 candidates"):
        opt.tell(opt.ask(40), [TARGET * 0.5] * 40)
    assert opt.status.sentence.startswith("All 40 candidates")
    opt.tell(opt.ask(8), losses=np.arange(8.0))
    assert opt.status.sentence.startswith("Still improving")


@pytest.mark.parametrize(
    ("points", "images", "number"),
    [
        (lambda i: [i], lambda i: 0.5, 40),
        (lambda i: [0], lambda i: 0.5, 0),  # one candidate, again and again
        (lambda i: [i], lambda i: 0.5 + (i == 15) / 9, 0),
        (lambda i: [i], lambda i: 0.5 + (i == 39) / 9, 0),  # said too early, and taken back
    ],
)
def test_different_candidates_count(
    points: Callable[[int], list[float]], images: Callable[[int], float], number: int
) -> None:
    same = SameImages(8)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for i in range(40):
            same.note(np.array([points(i)], float), np.full((1, 2, 2, 3), images(i)), np.ones(1))
    assert same.number == number
