"""Plugin of pytest: seeds of FIDE and of its tests are others, see README.md here.

    FIDE_SEEDS=4 python -m pytest -p tests.other_seeds tests/fide

A test that fails then depends on the luck of its seed: on another processor, which rounds
differently, it may fail without any plugin.  Seeds of `np.random.default_rng` are meant; networks,
and what takes a `SeedSequence` or `RandomState` of its own, keep theirs.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

_SEED = int(os.environ.get("FIDE_SEEDS", "1"))
if _SEED < 0:
    raise ValueError(f"FIDE_SEEDS must be a whole number >= 0, not {_SEED}")
_OURS = ("fide_plugins", "fide_lab", "tests")  # the scenes keep what they are made of
_numpys = np.random.default_rng


def _other_rng(seed: Any = None) -> np.random.Generator:
    """Make what `np.random.default_rng` makes, of another seed where one of ours asks with one."""
    caller = sys._getframe(1).f_globals.get("__name__", "")
    if seed is None or not caller.startswith(_OURS):
        return _numpys(seed)
    if isinstance(seed, np.random.SeedSequence):
        seed = [int(word) for word in seed.generate_state(4)]
    numbers = _flat(seed)
    return _numpys(seed if numbers is None else [_SEED, *numbers])


def _flat(seed: Any) -> list[int] | None:
    """Whole numbers of a seed; None for a generator, and for what is refused."""
    if isinstance(seed, int | np.integer):
        return [int(seed)]
    if not isinstance(seed, Sequence | np.ndarray) or isinstance(seed, str | bytes):
        return None
    parts = [_flat(part) for part in seed]
    return None if None in parts else [number for part in parts if part for number in part]


def pytest_configure() -> None:
    """Only as a plugin: doctests import every file."""
    np.random.default_rng = _other_rng
