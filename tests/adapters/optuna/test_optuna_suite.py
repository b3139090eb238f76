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

pytestmark = pytest.mark.filterwarnings("ignore:.*gets no images")

TARGET = np.full((8, 8, 3), 0.5)

VARIANTS: dict[str, dict[str, Any]] = {
    "target": {"target": TARGET, "seed": 0},
    "no target": {},
    "fast": {"target": TARGET, "preset": "fast"},
    "accurate": {"target": TARGET, "preset": "accurate"},
    "paper": {"target": TARGET, "preset": "paper"},
}
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in VARIANTS if name != "target"]


class TestPoint1(BasicSamplerTestCase, RelativeSamplerTestCase, SingleOnlySamplerTestCase):
    @pytest.fixture(params=["target", *SLOW])
    def sampler(self, request: pytest.FixtureRequest) -> Callable[[], FIDESampler]:
        return lambda: FIDESampler(**VARIANTS[request.param])
