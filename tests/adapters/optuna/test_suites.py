"""Optuna's own suites for samplers (acceptance point 1)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from optuna.testing.pytest_samplers import (
    BasicSamplerTestCase,
    RelativeSamplerTestCase,
    SingleOnlySamplerTestCase,
)

from fide_adapters.optuna import FIDESampler

TARGET = np.full((8, 8, 3), 0.5)

VARIANTS: dict[str, dict[str, Any]] = {
    "no target": {},
    "target": {"target": TARGET, "seed": 0},
}


class TestFIDESampler(BasicSamplerTestCase, RelativeSamplerTestCase, SingleOnlySamplerTestCase):
    @pytest.fixture(params=["target", pytest.param("no target", marks=pytest.mark.slow)])
    def sampler(self, request: pytest.FixtureRequest) -> Callable[[], FIDESampler]:
        return lambda: FIDESampler(**VARIANTS[request.param])
