"""The best renders of a run, so that they can be compared again."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from fide_plugins.runtime.schema import Schema, Stateful, array, flag, maybe, whole
from fide_plugins.types import Float32, Float64, Solution

_MOST = 16
_BYTES = 2**24  # of all of them; one is kept, however large


class Kept(Stateful):
    """Renders of the lowest losses, the best first.

    x: (n, d).  losses: (n,), in the present comparison.  evaluations: (n,), their numbers.
    given: (n,), whether the loss was told by the user.
    images: (n, H, W, C), packed if there are several views, the fourth channel is the coverage;
        None before the first.
    considered: generations of the run when the light was considered last.
    other_colors: whether the target's colors were none of the first renders'; None: not looked at.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {
        "x": array("n", "d", low=0.0, high=1.0),
        "losses": array("n"),
        "evaluations": array("n", kind="i", low=0),
        "given": array("n", kind="b"),
        "images": maybe(array("n", "H", "W", "channels")),
        "considered": whole(),
        "other_colors": maybe(flag),
    }

    def __init__(self, dim: int) -> None:
        self.x: Float64 = np.empty((0, dim))
        self.losses: Float64 = np.empty(0)
        self.evaluations = np.empty(0, np.int64)
        self.given = np.empty(0, np.bool_)
        self.images: Float32 | None = None
        self.considered = 0
        self.other_colors: bool | None = None

    def __len__(self) -> int:
        return len(self.x)

    @property
    def covered(self) -> bool:
        """Whether the renders have a coverage."""
        return self.images is not None and self.images.shape[3] == 4

    def note(
        self, x: Float64, images: Float32, losses: Float64, evaluation: int, *, given: bool
    ) -> None:
        """Keep what is better than what is kept; evaluation: number of the first of them."""
        if not len(images):
            return
        most = min(_MOST, max(1, _BYTES // images[0].nbytes))
        worst = self.losses[-1] if len(self) >= most else np.inf
        new = np.flatnonzero(losses < worst)  # False for NaN
        if not len(new):
            return
        if self.images is not None and self.images.shape[3] != images.shape[3]:
            channels = max(self.images.shape[3], images.shape[3])
            self.images, images = _with(self.images, channels), _with(images, channels)
        all_losses = np.concatenate([self.losses, losses[new]])
        order = np.argsort(all_losses, kind="stable")[:most]
        self.x = np.concatenate([self.x, x[new]])[order]
        self.losses = all_losses[order]
        self.evaluations = np.concatenate([self.evaluations, evaluation + new])[order]
        self.given = np.concatenate([self.given, np.full(len(new), given)])[order]
        old = images[:0] if self.images is None else self.images
        self.images = np.concatenate([old, images[new]])[order]

    def image_of(self, solution: Solution) -> Float32:
        """Image (H, W, C) of a solution, which has one, with its coverage where that is known."""
        assert solution.image is not None
        found = np.flatnonzero((self.x == solution.x).all(axis=1))
        if not len(found) or self.images is None or self.images.shape[3] < 4:
            return solution.image
        return np.concatenate([solution.image, self.images[found[0], ..., 3:]], axis=-1)

    def rank(self, losses: Float64) -> None:
        """Sort them by other losses (n,)."""
        order = np.argsort(losses, kind="stable")
        for name in ("x", "evaluations", "given", "images"):
            setattr(self, name, getattr(self, name)[order])
        self.losses = losses[order]


def _with(images: Float32, channels: int) -> Float32:
    """Images with so many channels; what has no coverage is covered."""
    if images.shape[3] == channels:
        return images
    return np.concatenate([images, np.ones_like(images[..., :1])], axis=-1)
