"""Constraints: only valid points are asked, drawn as they are within the valid region."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins import FIDE, Choice, Float, Group, Int, Space
from fide_plugins.errors import OptionError, ProtocolError
from fide_plugins.search.moves import Stage
from fide_plugins.types import Float64

TARGET = np.zeros((16, 16))


def disks(params: Any) -> Any:
    """Picture of two disks in a frame."""
    v, u = np.mgrid[0:16, 0:16] / 15
    image = np.full((16, 16), 0.1 * params["n"])
    for bead in params["beads"]:
        image += 0.4 / (1 + np.exp(20 * (np.hypot(u - bead["x"], v - bead["y"]) - 0.15)))
    return np.clip(image, 0, 1)


BEADS = Space(
    beads=2 * Group(x=Float(0, 1), y=Float(0, 1)),
    n=Int(0, 4),
    floor=Choice("a", "b", "c"),
    constraints={
        "apart": "hypot(beads[0].x - beads[1].x, beads[0].y - beads[1].y) > 0.45",
        "floor": 'floor != "b" and (floor == "a" or n < 3)',
    },
)
ANSWER = {"beads": [{"x": 0.2, "y": 0.3}, {"x": 0.7, "y": 0.6}], "n": 2, "floor": "c"}


@pytest.mark.parametrize("options", [{}, {"proposer": "none"}])
@pytest.mark.parametrize("many", [None, 1, 25])
def test_every_candidate_is_valid_whatever_it_is_for(
    many: int | None, options: dict[str, Any]
) -> None:
    opt = FIDE(BEADS, disks(ANSWER), seed=1, groups=[], patience=1, improvement=1.0, **options)
    stages = set()
    tested = many is None and not options
    while opt.evaluations < (250 if tested else 100):
        X = opt.ask(many)
        stages.add(opt.state.moves.stage)
        assert all(sum(BEADS.violations(p).values()) == 0 for p in BEADS.decode_many(X))
        opt.tell(X, [disks(p) for p in BEADS.decode_many(X)])
    assert not tested or Stage.RESTART in stages
    assert opt.validity is not None and 0.05 < opt.validity.share_rejected < 0.95


def test_the_answer_is_found_at_the_border_of_what_is_valid() -> None:
    space = Space(x=Float(0, 1), y=Float(0, 1))
    v, u = np.mgrid[0:16, 0:16] / 15

    def draw(p: Any) -> Any:
        return np.exp(-((u - p["x"]) ** 2 + (v - p["y"]) ** 2) / 0.05)

    for seed in range(2):
        answer = {"x": 0.75, "y": 0.6}
        opt = FIDE(
            space, draw(answer), seed=seed, constraints=lambda p: [p["x"] - 0.75, p["y"] - 0.6]
        )
        for _ in range(20):
            X = opt.ask()
            opt.tell(X, [draw(p) for p in space.decode_many(X)])
        best = opt.best
        assert best is not None and best.params == pytest.approx(answer, abs=1e-3)


@pytest.mark.parametrize(
    ("valid", "message"),
    [
        (lambda x: x[0] > 0.97 and x[1] < 0.1, ""),
        (lambda x: (np.hypot(*(x - [0.93, 0.21])) - 1e-3, -1.0), ""),  # found by its margin
        (lambda x: np.array([np.False_, x[0] > 0.1]), "no valid point was found.*violates nothing"),
        (lambda x: float("nan"), "no valid point was found"),
    ],
)
def test_the_first_search_begins_at_a_valid_point(
    valid: Callable[[Float64], Any], message: str
) -> None:
    if message:
        with pytest.raises(OptionError, match=message.replace("nothing", "constraints")):
            FIDE(2, TARGET, constraints=valid, seed=0)
        return
    opt = FIDE(2, TARGET, constraints=valid, seed=0)
    for x in [opt.state.search.mean, *opt.ask(30)]:
        found = valid(x)
        assert (np.max(found) <= 0) if isinstance(found, tuple) else found


def test_a_start_that_violates_a_constraint_is_refused_by_name() -> None:
    space = Space(a=Float(0, 1), b=Float(0, 1), constraints={"wall": "a < 0.6 * b"})
    with pytest.raises(OptionError, match=re.escape("x0 is not valid: it violates wall (a < 0.6")):
        FIDE(space, TARGET, x0={"a": 0.9, "b": 0.2})
    opt = FIDE(space, TARGET, x0={"a": 0.1, "b": 0.9}, seed=0)
    np.testing.assert_allclose(opt.state.search.mean, [0.1, 0.9])
    assert space.violations(space.decode(FIDE(space, TARGET, seed=0).state.search.mean)) == {
        "wall": 0.0
    }


@pytest.mark.parametrize(
    ("function", "message"),
    [
        ("a < b", r"must be a function.*Space\(\.\.\., constraints=\{'wall'"),
        (lambda x: None, "returned None; let it return True where the parameters are valid"),
        (lambda x: "yes", "returned 'yes'"),
        (lambda x: [], r"returned \[\]"),
        (lambda x: 1 / 0, "raised ZeroDivisionError.*return False there"),
    ],
)
def test_a_wrong_function_is_refused_before_anything_is_asked(function: Any, message: str) -> None:
    with pytest.raises(OptionError, match=message):
        FIDE(2, TARGET, constraints=function, seed=0)


def test_a_checkpoint_knows_the_constraints_of_a_space_and_asks_for_a_function(
    tmp_path: Path,
) -> None:
    space = Space(a=Float(0, 1), b=Float(0, 1), constraints={"wall": "a < 0.6 * b"})
    opt = FIDE(space, TARGET, seed=0)
    opt.tell(X := opt.ask(), losses=X[:, 0])
    opt.save(tmp_path / "a")
    np.testing.assert_array_equal(FIDE.load(tmp_path / "a").ask(9), opt.ask(9))

    def valid(x: Float64) -> bool:
        return bool(x[0] < 0.2)

    own = FIDE(2, TARGET, seed=0, constraints=valid)
    own.tell(X := own.ask(), losses=X[:, 0])
    own.save(tmp_path / "b")
    loaded = FIDE.load(tmp_path / "b")
    assert loaded.best is not None and len(loaded.recommend()) == 2
    with pytest.raises(ProtocolError, match="saved with a function of constraints"):
        loaded.ask(9)
    np.testing.assert_array_equal(FIDE.load(tmp_path / "b", constraints=valid).ask(9), own.ask(9))
