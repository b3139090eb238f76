"""NumPy's global generator as the baselines lend it to a library, for the library's own runs."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np


@contextmanager
def seeded_globally(seed: int) -> Iterator[None]:
    """With that generator seeded, and without the library's warnings."""
    users: Any = np.random.get_state()
    bits = np.random.MT19937(np.random.SeedSequence(seed))
    np.random.set_state(np.random.RandomState(bits).get_state())
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        np.random.set_state(users)
