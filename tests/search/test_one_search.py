"""One search: a point that is no member of its generation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fide_plugins.options import Options
from fide_plugins.population import Candidate
from fide_plugins.search.mixed import Axes
from fide_plugins.search.moves import Start
from fide_plugins.search.one_search import Search, Setting
from fide_plugins.types import Float64

D, K = 3, 6
POINT = np.array([0.45, 0.55, 0.5])


def new_search() -> Search:
    sigma0 = np.full(D, 1 / 6)
    return Search(Start(np.full(D, 0.5), sigma0), np.inf, Setting(K, sigma0, Options(), Axes(D)))


def generation(search: Search) -> tuple[list[Candidate], Float64]:
    """Members of a generation, the fourth of which is the worst, and their losses."""
    X, Z = search.sample(K, np.random.default_rng(0))
    members = [Candidate(i, x, z) for i, (x, z) in enumerate(zip(X, Z, strict=True))]
    return members, np.array([3.0, 1.0, 2.0, 9.0, 5.0, 4.0])


@pytest.mark.parametrize("loss", [8.9, 9.0])
def test_a_point_takes_the_place_of_the_worst_member_if_it_is_better(loss: float) -> None:
    told, other = new_search(), new_search()
    members, losses = generation(told)
    told.tell(members, losses, (POINT, loss))
    if loss < 9.0:
        z = other.closest(POINT[None])[0]
        members[3] = replace(members[3], x=POINT, z=z, off_distribution=True)  # not drawn now
    other.tell(members, losses, None)
    assert repr(told.state_dict()["distribution"]) == repr(other.state_dict()["distribution"])
