"""Renders smaller than the target: both are brought to one resolution before they are compared."""

from __future__ import annotations

from typing import Any

import numpy as np

from fide_plugins.runtime.opencv import cv2
from fide_plugins.types import Float32
from fide_plugins.views.views import View, Views


def reduced(views: Views, size: tuple[int, int]) -> Views:
    """Views of size (h, w): means of the pixels of each target, and of their weights."""

    def smaller(pixels: Any) -> Float32:
        made = cv2.resize(pixels, size[::-1], interpolation=cv2.INTER_AREA)
        return np.ascontiguousarray(np.clip(made, 0.0, 1.0))

    made = []
    for view in views.views:
        weights = None if view.weights is None else smaller(view.weights)
        if weights is not None:
            weights /= max(float(weights.max()), 1e-12)
        made.append(View(smaller(view.target), weights))
    return Views(made, listed=views.listed, values=views.values)


def enlarged(small: Views, views: Views, batch: Float32) -> Float32:
    """Renders (n, h, w, C) of small views, packed, with the size of the others, bilinearly."""
    parts = []
    for part, view in zip(small.split(batch), views.views, strict=True):
        size = view.size[::-1]
        made = np.empty((len(part), *view.size, part.shape[-1]), np.float32)
        for i, image in enumerate(part):
            larger = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
            made[i] = larger.reshape(made.shape[1:])
        parts.append(made)
    return views.pack(parts, (len(batch),))


def seen_at(views: Views, small: Views) -> Views:
    """The views with targets as the small ones show them, enlarged as renders are."""
    batch = enlarged(small, views, small.target[None])
    targets = [part[0].copy() for part in views.split(batch)]
    made = [View(t, view.weights) for t, view in zip(targets, views.views, strict=True)]
    return Views(made, listed=views.listed, values=views.values)
