"""Where the search for another picture begins."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fide_plugins.search.mixed import Axes
from fide_plugins.search.recall import recall
from fide_plugins.search.scene import Exchangeability

from .conftest import sample


@pytest.mark.parametrize("far", [[], [0.05], [0.15], [0.4]])
def test_it_is_as_wide_as_candidates_differ_and_no_wider_than_the_first(far: list[float]) -> None:
    """However faint their images are; as wide as the first if there is one candidate only."""
    x, sigma0 = np.array([0.4, 0.5]), np.array([0.1, 0.2])
    samples = [sample(0.1 * at, at) for at in (x, *(x + step for step in far))]
    known: Any = SimpleNamespace(
        sigma0=sigma0, target=sample(np.zeros(2), x).tokens, channels=3, axes=Axes(2),
        exchangeability=Exchangeability(Axes(2), 3, []),
    )  # fmt: skip
    start = recall(samples, known, samples[0].tokens, popsize=4, learned=1).start
    np.testing.assert_allclose(start.std, np.minimum(sum(far) or 1, sigma0))
