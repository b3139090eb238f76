"""What a learned model leaves open is drawn again around the best so far."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fide_plugins.search.hypotheses import Hypotheses, Resample
from fide_plugins.search.mixed import Axes
from fide_plugins.search.moves import Known, Stage
from fide_plugins.search.policy import MovePolicy
from fide_plugins.search.scene import Exchangeability, Sensitivity
from fide_plugins.types import Float64, Posterior

from ..conftest import sample

HERE = np.array([0.3, 0.7, 0.2, 0.5])
KNOWN, OPEN = [0, 1], [2, 3]


def scene(
    x: Float64 = HERE, axes: Axes | None = None, groups: list[list[int]] | None = None
) -> Known:
    """A search ended at x."""
    d = len(x)
    axes = axes or Axes(d)
    known = Known(
        x0=np.full(d, 0.5),
        sigma0=np.full(d, 1 / 6),
        target=torch.zeros(16, 3),
        channels=3,
        exchangeability=Exchangeability(axes, 3, groups or []),
        sensitivity=Sensitivity(axes, 3),
        axes=axes,
    )
    known.incumbent = sample(np.zeros(16), x)
    known.optima.note(known.incumbent, known.exchangeability.distance)
    return known


def hypotheses(n: int = 512, seed: int = 0) -> Float64:
    """They agree in two parameters, have two values in the third, and any in the last."""
    rng = np.random.default_rng(seed)
    x = np.tile(HERE, (n, 1)) + 0.01 * rng.standard_normal((n, 4))
    x[:, 2] = np.where(rng.random(n) < 0.5, 0.2, 0.74)
    x[:, 3] = rng.random(n)
    return np.clip(x, 0, 1)


@pytest.mark.parametrize("n", [1, 2, 7, 20])
def test_candidates_keep_what_is_known_and_have_values_of_hypotheses(n: int) -> None:
    known, there = scene(), hypotheses()
    x = Resample(Hypotheses(Posterior(there), 4)).draw(known, n, np.random.default_rng(1))
    assert x.shape == (n, 4)
    np.testing.assert_array_equal(x[:, KNOWN], np.tile(HERE[KNOWN], (n, 1)))
    for axis in OPEN:
        moved = x[:, axis] != HERE[axis]
        assert np.isin(x[moved, axis], there[:, axis]).all()
    assert ((x[::2] != HERE).sum(axis=1) == 1).all()  # every second one in a single parameter
    together = x[1::2]
    assert all((there[:, OPEN] == row[OPEN]).all(axis=1).any() for row in together)


def test_there_is_nothing_to_draw_where_hypotheses_agree_or_there_are_none() -> None:
    there = hypotheses()
    there[:, OPEN] = HERE[OPEN]
    assert not Resample(Hypotheses(Posterior(there), 4)).possible(scene())
    assert not Resample(Hypotheses(None, 4)).possible(scene())
    assert Resample(Hypotheses(Posterior(hypotheses()), 4)).possible(scene())
    assert not Resample(Hypotheses(Posterior(hypotheses()), 4)).possible(
        scene(groups=[[0, 1], [2, 3]])
    )


def policy() -> MovePolicy:
    return MovePolicy(
        np.full(4, 0.5), np.full(4, 1 / 6), 9, torch.zeros(16, 3), 3, 0, [],
        posterior=Posterior(hypotheses()),
    )  # fmt: skip


def test_it_follows_a_search_from_a_hypothesis_and_itself_while_it_helps() -> None:
    moves, rng = policy(), np.random.default_rng(0)
    several = [sample(np.full(16, 0.1), x, 1.0 + 0.001 * i) for i, x in enumerate(moves.draw(rng))]
    moves.learn(several, several[0].x)
    assert moves.hypotheses is not None and moves.hypotheses.waiting
    seen, loss = [], 1.0
    for helps in (True, True, False):
        loss *= 0.5 if helps else 1.0
        found = sample(np.full(16, 0.1), np.append(HERE[:3], loss), loss if helps else 2 * loss)
        moves.after_search(found, 100, guided=True)
        seen.append((moves.stage, moves.move))
        if moves.stage is Stage.RESTART:
            draws = [sample(np.full(16, 0.1), x, 3.0) for x in moves.draw(rng)]
            moves.learn(draws, draws[0].x)
    assert seen == [
        (Stage.RESTART, "resample"),
        (Stage.RESTART, "resample"),
        (Stage.SEARCH, "learned"),
    ]


def test_a_search_by_losses_alone_goes_on_with_the_next_hypothesis() -> None:
    moves, rng = policy(), np.random.default_rng(0)
    x = moves.draw(rng)
    moves.learn([sample(np.full(16, 0.1), row, 1.0 + i) for i, row in enumerate(x)], x[0])
    moves.after_search(None, 100, guided=False)
    assert moves.stage is Stage.SEARCH
    assert moves.move == "learned" and not moves.guided


def test_the_best_hypothesis_is_completed_once() -> None:
    """In the parameters that others leave open; it is among what is chosen from afterwards."""
    known, there = scene(), hypotheses()
    found = [(1.0, there[0]), (0.5, HERE), (2.0, there[1])]
    learned = Hypotheses(Posterior(there), 4)
    learned.covered = True  # losses say enough
    assert not learned.complete(found, known)
    learned.covered = False
    assert learned.complete(found, known)
    x = learned.draw(known, 20, np.random.default_rng(0))
    np.testing.assert_array_equal(x[:, KNOWN], np.tile(HERE[KNOWN], (len(x), 1)))
    assert (x[:, OPEN] != HERE[OPEN]).any(axis=1).all()
    again = Hypotheses(None, 4)
    again.load_state_dict(learned.state_dict())
    np.testing.assert_array_equal(again.draw(known, 20, np.random.default_rng(0)), x)
    learned.learn([*learned.before, (0.7, x[0])], x[0], known.exchangeability.distance)
    np.testing.assert_array_equal(learned.next(known, learned.begin_at(known, HERE)).mean, HERE)
    assert not learned.complete(found, known)


def test_where_hypotheses_agree_nothing_is_completed() -> None:
    there = hypotheses()
    there[:, OPEN] = HERE[OPEN]
    assert not Hypotheses(Posterior(there), 4).complete([(1.0, HERE)], scene())


def test_after_descents_a_search_is_narrow_but_in_what_is_open() -> None:
    there = hypotheses()
    there[:, OPEN] = np.random.default_rng(1).random((len(there), 2))
    known, learned = scene(), Hypotheses(Posterior(there), 4)
    learned.replace(HERE[None])
    std = learned.next(known, learned.begin_at(known, HERE + 0.01)).std
    assert (std[KNOWN] <= 0.02).all() and (std[OPEN] > 0.05).all()
