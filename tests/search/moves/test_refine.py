"""The incumbent itself is searched closely, to the end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from fide_plugins.options import Options
from fide_plugins.search.exchangeability import Exchangeability
from fide_plugins.search.moves import Known, Refine
from fide_plugins.search.one_search import Search, Setting
from fide_plugins.search.scene import Axes, Removal, Sensitivity

from ..conftest import sample

D = 4


@pytest.fixture
def known() -> Known:
    known = Known(
        x0=np.full(D, 0.5),
        sigma0=np.full(D, 1 / 6),
        target=torch.zeros(16, 3),
        channels=3,
        exchangeability=Exchangeability(D, 3, []),
        removal=Removal(),
        sensitivity=Sensitivity(D, 3),
        axes=Axes(D),
    )
    known.incumbent = sample(np.zeros(16), np.full(D, 0.3))
    known.optima.note(known.incumbent, known.exchangeability.distance)
    return known


def test_it_begins_narrowly_and_patiently_at_the_incumbent_once(known: Known) -> None:
    assert not Refine().possible(known), "nothing has failed yet"
    known.optima.fail(known.current)
    assert Refine().possible(known)
    start = Refine().begin_at(known, np.zeros(D))
    np.testing.assert_array_equal(start.mean, known.current.x)
    assert start.std.max() < 0.05 * known.sigma0.max() and start.patience == 3
    assert start.to_the_end and Refine().possible(known)
    Refine().note_begun(known, start.mean)
    assert not Refine().possible(known)


@pytest.mark.parametrize("to_the_end", [True, False])
def test_its_search_goes_on_where_others_have_collapsed(known: Known, to_the_end: bool) -> None:
    start = replace(Refine().begin_at(known, known.current.x), to_the_end=to_the_end)
    search = Search(start, np.inf, Setting(8, known.sigma0, Options()))
    ended_at = []
    for generation in range(40):  # it halves in each, and so does the loss
        search.termination.note(np.array([0.5**generation]))
        search.distribution.sigma *= 0.5
        if search.is_over(guided=True):
            ended_at.append(float(search.std.max()))
    assert max(ended_at) < (2e-8 if to_the_end else 1e-3)
    assert max(ended_at) > (4e-9 if to_the_end else 2.5e-4)
