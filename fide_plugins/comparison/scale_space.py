"""Coarse first: the blur at which a search compares target and renders, until it is there.

Thin or repeated structures have no basin of a useful width: unless a render is nearly right, its
loss says nothing of how far it is.  Blurred, they have one (Witkin 1983, "Scale-space filtering").
When a blurred search is over, or narrower than the blur, the next one begins at its best candidate
with a smaller blur, the last one with none.  `FIDE.best` is always sharp.

Where regions are wide and flat a blur hides what counts.  So the first candidates decide: if their
parameters follow better from blurred images than from sharp ones, by a linear model that has not
seen them, such a search is one of the moves (`search.moves.Coarsen`); if much better, or if sharp
features hardly agree with the losses, the first search begins again at once, coarse.  Of
photographs whose renders say what they draw all searches begin coarse, at blurs that leave enough
contrast.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from fide_plugins.runtime.opencv import cv2
from fide_plugins.runtime.schema import (
    Schema,
    Stateful,
    anything,
    array,
    each,
    flag,
    maybe,
    real,
    row,
    whole,
)
from fide_plugins.types import Float32, Float64
from fide_plugins.views import Views

if TYPE_CHECKING:
    from fide_plugins.comparison.kept import Kept
    from fide_plugins.search.moves import Start

BLURS = (0.05, 0.025, 0.0125)
"""Standard deviations of one search after another, in sides of the image; then sharp."""
_PHOTO_BLURS = (0.08, *BLURS)  # where renders have a coverage that leaves contrast at BLURS[0]
WIDTHS = (0.6, 0.6, 0.5, 0.4)
"""Widest beginning of the searches that follow the first, of its beginning; the last is sharp."""
REACH = 1 / 3
"""Standard deviation of a search that sees no more at a blur: of that, in sides of the image."""
NEXT = 2.0  # times the spread of a search that is over: of the next one
PATIENCE, IMPROVEMENT = 2, 1.0
"""Of coarse searches, in units of the run's: their losses are small, and fall slowly."""
PATIENCE_ASKED, IMPROVEMENT_ASKED = 8, 0.2
"""The same where the user asks for them: what the renderer cannot draw stays in all losses."""
_JUDGED = (0.04, 0.08)  # blurs that are compared with sharp images, in sides of the image
_SEEN = 36  # candidates that decide
_SIDE = 96  # pixels to which their images are reduced
_LEAST_CONTRAST = 0.05  # of the variance of a sharp render, in what it covers
_LEAST = 1.1, 0.05  # ratio and gain of the predictability, for blurs to be useful
_MUCH, _LITTLE = 1.6, 0.8  # such a ratio, or so little agreement: the first search begins again
_HARDLY, _LEAST_IF_HARDLY = 0.7, (1.03, 0.02)  # less agreement, and then the same
_RIDGES = np.geomspace(1e-4, 1.0, 7)


class ScaleSpace(Stateful):
    """The blur of the present search, and of those that follow it; whether blurs are useful.

    views: of the target.
    possible: whether images can be compared blurred at all.
    at_once: whether the first search begins coarse, without asking the first candidates.
    photo: whether all do where renders have a coverage.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {
        "useful": maybe(flag),
        "asked": flag,
        "blurs": each(real(0.0, 1.0), most=len(WIDTHS)),
        "left": each(real(0.0, 1.0), most=len(WIDTHS)),
        "seen": each(row(whole(), array("d"), each(anything))),
    }

    def __init__(
        self, views: Views, *, possible: bool, at_once: bool = False, photo: bool = False
    ) -> None:
        self._views, self._photo = views, photo
        self.blurs: list[float] = list(BLURS)
        """Of a search that begins coarse and those that follow it, in sides of the image."""
        self.asked = at_once and possible
        """Whether all searches are as patient as pictures need that no render resembles."""
        self._side = min(min(view.size) for view in views.views)
        self.useful: bool | None = (at_once or None) if possible else False
        """None: the first candidates have not decided."""
        self.left: list[float] = list(BLURS) if at_once and possible else []
        """Blurs of the present search and of those that follow it, in sides of the image."""
        self._seen: list[tuple[int, Float64, list[Float32]]] = []

    @property
    def blur(self) -> float:
        """Standard deviation of the present blur, in pixels; 0: images are sharp."""
        return self.left[0] * self._side if self.left else 0.0

    def patient(self, start: Start) -> Start:
        """Where a search begins, with the patience of a coarse one where it is one."""
        if not self.blur:
            return start
        if self.asked:
            return replace(start, patience=PATIENCE_ASKED, improvement=IMPROVEMENT_ASKED)
        return replace(start, patience=PATIENCE, improvement=IMPROVEMENT)

    # -- the first candidates ----------------------------------------------------------------------

    def note(self, index: int, x: Float64, image: Float32) -> None:
        """Note a candidate x (d,) with its sharp image, packed; only the first ones are needed."""
        if self.useful is None and index < 2 * _SEEN:
            self._seen.append((index, x.copy(), self._small(image)))

    def decide(
        self, target: Float32, agreement: float, start: Float64, kept: Kept | None
    ) -> Float64 | None:
        """Whether blurs are useful, once enough candidates are known; where to begin coarse, (d,).

        None: the present search goes on sharp.

        target: packed, sharp.  agreement: rank correlation of losses and distances in features.
        start: (d,), where the present search began.
        kept: the best renders; None: they are compared as they are.
        """
        if self.useful is not None or len(self._seen) < _SEEN:
            return None
        if self._photo and kept is not None and kept.covered:
            return start if self._begin_photo(kept) else None
        seen = sorted(self._seen, key=lambda one: one[0])[:_SEEN]
        X = np.array([x for _, x, _ in seen])
        scores = [predictability(_flat(seen, blur), X) for blur in (0.0, *_JUDGED)]
        sharp, best = scores[0], max(scores)
        hardly = agreement < _HARDLY and not self._photo
        ratio, gain = _LEAST_IF_HARDLY if hardly else _LEAST
        self.useful = best >= ratio * sharp and best - sharp >= gain
        self.asked = self.useful and hardly
        self._seen = []
        if not self.useful or not (best >= _MUCH * sharp or agreement < _LITTLE):
            return None
        self.left = list(self.blurs)
        apart = _flat(seen, BLURS[0]) - _flat([(0, X[0], self._small(target))], BLURS[0])
        first: Float64 = X[int(np.argmin(np.square(apart).mean(axis=1)))]
        return first

    def _begin_photo(self, kept: Kept) -> bool:
        """Begin coarse with the blurs that leave enough contrast; returns whether one does."""
        self._seen, self.asked = [], True
        left = [contrast(self._views, kept, share * self._side) for share in (0.0, *BLURS)]
        enough = _LEAST_CONTRAST * left[0]
        self.blurs = [b for b, one in zip(BLURS, left[1:], strict=True) if one >= enough]
        if len(self.blurs) == len(BLURS):
            self.blurs = list(_PHOTO_BLURS)
        self.useful, self.left = bool(self.blurs), list(self.blurs)
        return self.useful

    def _small(self, image: Float32) -> list[Float32]:
        """Pictures of the views, averaged to at most 96 pixels along a side, of a packed image."""
        small = []
        for part in self._views.split(image[None]):
            height, width = part.shape[1:3]
            factor = max(1.0, min(height, width) / _SIDE)
            size = max(1, round(width / factor)), max(1, round(height / factor))
            small.append(np.asarray(cv2.resize(part[0], size, interpolation=cv2.INTER_AREA)))
        return small

    # -- searches ----------------------------------------------------------------------------------

    def begin_at(self, share: float) -> None:
        """Compare at one blur, in sides of the image, and no other after it; 0: sharp."""
        self.left = [share] if share else []

    def go_on(self) -> float:
        """Take the next blur; returns how wide the search with it may begin, of the first one."""
        del self.left[0]
        return WIDTHS[-1 - len(self.left)]

    def end(self) -> None:
        """Compare sharp images from now on."""
        self.left = []

    def give_up(self) -> None:
        """Never begin coarse again: images are not compared here, or by a user's own losses."""
        self.end()
        self.useful, self._seen = False, []


def blurred(image: Float32, blur: float) -> Float32:
    """An image (H, W, C) behind a Gaussian filter, with its own pixels beyond the border.

    blur: standard deviation in pixels; a large one filters a smaller image.
    """
    if not blur:
        return image
    height, width = image.shape[:2]
    factor = max(1, int(blur / 2))
    size = max(1, round(width / factor)), max(1, round(height / factor))
    small: Any = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if factor > 1 else image
    small = cv2.GaussianBlur(small, (0, 0), blur / factor, borderType=cv2.BORDER_REPLICATE)
    if factor > 1:
        small = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(small, np.float32).reshape(image.shape)


def contrast(views: Views, kept: Kept, blur: float) -> float:
    """Variance of blurred renders in what they cover; blur: standard deviation in pixels."""
    assert kept.images is not None
    found = []
    for image in kept.images:
        for part in views.split(image[None]):
            shown = blurred(np.ascontiguousarray(part[0, ..., :3]), blur)
            weights = np.broadcast_to(part[0, ..., 3:], shown.shape)
            if weights.any():
                mean = np.average(shown, axis=(0, 1), weights=weights)
                found.append(float(np.average(np.square(shown - mean), weights=weights)))
    return float(np.mean(found)) if found else 0.0


def _flat(seen: list[tuple[int, Float64, list[Float32]]], share: float) -> Float32:
    """Blurred images as rows (n, ...); share: standard deviation in sides of the image."""
    side = min(min(part.shape[:2]) for part in seen[0][2])
    return np.array(
        [
            np.concatenate([blurred(part, share * side).ravel() for part in images])
            for _, _, images in seen
        ]
    )


def predictability(images: Float32 | Float64, X: Float64) -> float:
    """How well parameters X (n, d) follow from images (n, p) by a linear model, in [0, 1].

    The mean over the parameters of 1 - e / v, at least 0, with e the mean squared error of the
    model of all other candidates, and v that of their mean: ridge regression, with the ridge of
    seven that is best.
    """
    n = len(X)
    centered = images - images.mean(axis=0, dtype=np.float64).astype(images.dtype)
    values, vectors = np.linalg.eigh((centered @ centered.T).astype(np.float64))
    values = np.maximum(values, 0.0)
    if not values.any():
        return 0.0
    deviations = X - X.mean(axis=0)
    variance = np.maximum(np.square(deviations).sum(axis=0), 1e-300) * (n / (n - 1)) ** 2
    best = 0.0
    for ridge in _RIDGES * values.mean():
        kept = values / (values + ridge)
        hat = (vectors * kept) @ vectors.T + 1 / n
        left_out = 1 - np.minimum(np.diag(hat), 1 - 1e-9)
        errors = np.square((deviations - hat @ deviations) / left_out[:, None]).sum(axis=0)
        best = max(best, float(np.maximum(0.0, 1 - errors / variance).mean()))
    return best
