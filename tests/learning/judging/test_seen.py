"""Which parameters are said to be shown by the images."""

from __future__ import annotations

import numpy as np
import pytest

from fide_plugins.learning import learn
from fide_plugins.learning.judging import are_shown, of_any_block, scores
from fide_plugins.space import Float, Space
from fide_plugins.types import Float64, Indices
from tests.learning.conftest import SIDE

NONE: Indices = np.empty((0, 0), np.intp)
TWO: Indices = np.array([[1, 2], [3, 4]])


def scored(
    rng: np.random.Generator, known: list[float], blocks: Indices, n: int = 60, offset: float = 0.0
) -> Float64:
    """Scores (n, 2, d) of samples with these errors; 1: they say nothing of the truth, but surely.

    The blocks of samples come in another order than those of the truth in every second image.
    """
    found = []
    for i in range(n):
        truth = rng.random(len(known))
        where = np.where(np.array(known) < 1, truth, rng.random(len(known)))
        spread = np.where(np.array(known) < 1, known, 0.05)
        samples = np.clip(where + spread * rng.standard_normal((99, len(known))), 0, 1)
        if blocks.size and i % 2:
            samples[:, blocks] = samples[:, blocks[::-1]]
        found.append(scores(samples, truth, np.zeros(len(known), bool), blocks))
    return np.array(found)


def test_a_model_that_is_sure_and_wrong_shows_nothing() -> None:
    told = scored(np.random.default_rng(0), [0.05, 1, 0.2], NONE)
    np.testing.assert_array_equal(are_shown(told, ["a", "b", "c"]), [True, False, True])


def test_one_axis_of_a_choice_is_enough() -> None:
    told = scored(np.random.default_rng(0), [0.05, 1, 1], NONE)
    np.testing.assert_array_equal(are_shown(told, ["a", "a", "b"]), [True, True, False])


@pytest.mark.parametrize("hidden", [True, False])
def test_exchangeable_blocks_have_one_score(hidden: bool) -> None:
    """To match them by an axis that is not shown would seem to say something of it."""
    unknown = 1.0 if hidden else 0.05
    told = scored(np.random.default_rng(1), [1, 0.05, unknown, 0.05, unknown], TWO)
    names = of_any_block(["level", "l[0].x", "l[0].y", "l[1].x", "l[1].y"], TWO)
    assert names == ["level", "l.x", "l.y", "l.x", "l.y"]
    assert are_shown(told, names).tolist() == [False, True, not hidden, True, not hidden]


def test_the_only_axis_of_blocks_is_judged_without_another() -> None:
    blocks = np.array([[0], [1]])
    known = scored(np.random.default_rng(2), [0.05, 0.05], blocks)
    assert are_shown(known, ["x[0]", "x[1]"]).all()
    unknown = scored(np.random.default_rng(2), [1, 1], blocks)
    assert not are_shown(unknown, ["x[0]", "x[1]"]).any()


def test_names_that_differ_in_more_than_a_number_stay() -> None:
    blocks = np.array([[0, 1], [2, 3]])
    for names in (["a", "b", "c", "d"], ["x[0]", "x[1]", "x[2]", "x[3]"]):
        assert of_any_block(names, blocks) == names
    nested = ["row[1].l[0].x", "row[1].l[0].y", "row[1].l[1].x", "row[1].l[1].y"]
    assert of_any_block(nested, blocks) == ["row[1].l.x", "row[1].l.y"] * 2


def test_nothing_is_learned_of_a_picture_that_only_noise_changes() -> None:
    """The density of its parameter is a little wrong, and surely so."""
    rng = np.random.default_rng(0)
    space, flat = Space(a=Float(0, 1)), lambda params: 0.5 + 0.01 * rng.random((SIDE, SIDE))
    report = learn(flat, space, renders=300, size=SIDE, passes=2).report
    assert report.unseen == ("a",)
    assert "nothing was learned of any of the 1 parameters" in str(report)
