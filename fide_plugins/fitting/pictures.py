"""Images of one view or several, between the user's function, the optimizer and a file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fide_plugins.errors import ImageError
from fide_plugins.types import Float32
from fide_plugins.validation.values import Clipping

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE


def as_told(optimizer: FIDE, image: Any) -> Any:
    """What `FIDE.tell` takes for one candidate; image: as the user's function returned it."""
    if image is None:
        raise ImageError("render returned None; let it return its image")
    target: Any = optimizer.target
    if not isinstance(target, list):
        return [image]
    several = isinstance(image, list | tuple)
    if not several or len(image) != len(target):
        got = f"{len(image)} images" if several else type(image).__name__
        raise ImageError(
            f"render must return a list of {len(target)} images, one for each view, not {got}"
        )
    for view, one in enumerate(image):
        if one is None:
            raise ImageError(f"render returned None for view {view}; let it return its image")
    return [[one] for one in image]


def canonical(optimizer: FIDE, image: Any) -> Float32:
    """Image (H, W, 3), packed, that the optimizer makes of it; clipped without a warning."""
    packed: Float32 = optimizer.evaluator.colors(as_told(optimizer, image), 1, Clipping().note)[0]
    return packed


def as_compared(optimizer: FIDE, image: Any) -> Float32:
    """The same in the light of the target, and over it where it covers nothing."""
    told, evaluator = as_told(optimizer, image), optimizer.evaluator
    batch = evaluator.as_batch(1, told, np.zeros(1), Clipping().note)
    assert batch is not None  # an image was given
    return evaluator.shown(batch[0])


def best_compared(optimizer: FIDE) -> Float32 | None:
    """The best image (H, W, 3), packed, as `as_compared`; None without one."""
    best, kept = optimizer.state.best, optimizer.state.kept
    if best is None or best.solution.image is None:
        return None
    image = best.solution.image if kept is None else kept.image_of(best.solution)
    return optimizer.evaluator.shown(image)


def shown(optimizer: FIDE, image: Float32) -> Any:
    """A packed image (H, W, 3), or a list of its views, in the user's values."""
    return optimizer.views.restored(optimizer.views.unpacked(image))


def picture(optimizer: FIDE, image: Float32) -> Float32:
    """One picture of it with values in [0, 1]."""
    return side_by_side(optimizer.views.unpacked(image))


def side_by_side(image: Any) -> Float32:
    """One picture of an image (H, W, 3), or of a list of them, below each black."""
    images = image if isinstance(image, list) else [image]
    height = max(len(one) for one in images)
    padded = [np.pad(one, ((0, height - len(one)), (0, 0), (0, 0))) for one in images]
    return np.concatenate(padded, axis=1, dtype=np.float32)


def counting(weights: Any, target: Any) -> Float32 | None:
    """Weights (H, W) of views side by side; None: all pixels of the target, or targets, count."""
    if weights is None:
        return None
    views = [weights] if not isinstance(weights, list) else weights
    targets = [target] if not isinstance(target, list) else target
    pairs = zip(views, targets, strict=True)
    return side_by_side(
        [np.ones_like(one) * (1 if w is None else np.asarray(w)[..., None]) for w, one in pairs]
    )[..., 0]
