"""Libraries that draw from the global generators of NumPy and Python get some of their own."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from fide_lab.baselines.penalty import quietly

__all__ = ["GlobalRandom"]


class GlobalRandom:
    """States of both global generators, made from a seed, to be lent to a library."""

    def __init__(self, seed: int) -> None:
        self._python = random.Random(seed).getstate()
        bits = np.random.MT19937(np.random.SeedSequence(seed))
        self._numpy = np.random.RandomState(bits).get_state()

    @contextmanager
    def lent(self) -> Iterator[None]:
        """The library may draw; afterwards the user's own states are as they were."""
        users = random.getstate(), np.random.get_state()
        random.setstate(self._python)
        np.random.set_state(self._numpy)
        try:
            yield
        finally:
            self._python, self._numpy = random.getstate(), np.random.get_state()
            random.setstate(users[0])
            np.random.set_state(users[1])

    @contextmanager
    def lent_quietly(self) -> Iterator[None]:
        """The same, without the library's warnings."""
        with self.lent(), quietly():
            yield
