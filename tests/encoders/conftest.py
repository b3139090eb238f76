"""Encoders of every name: those with a network get random weights, laid out like the real ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from fide_plugins import encoders
from fide_plugins.encoders.base import PatchEncoder


@pytest.fixture
def make(request: pytest.FixtureRequest) -> Callable[..., PatchEncoder]:
    """Replacement of `encoders.make` that finds weights for every name."""

    def make(name: str, **options: Any) -> PatchEncoder:
        if name == "dinov3":
            options["variant"] = str(request.getfixturevalue("dino_folders")["dinov3"])
        elif name == "vgg19":
            request.getfixturevalue("cached_weights")
        return encoders.make(name, **options)

    return make
