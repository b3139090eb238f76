"""The film of a run: its best image after 1, 3, 10, 30, 100, ... renders, and at the end."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from fide_plugins.types import Float32

__all__ = ["frames", "marks"]


def marks(budget: int) -> list[int]:
    """Numbers of renders after which a frame is kept; the last one is `budget`.

    >>> marks(500)
    [1, 3, 10, 30, 100, 300, 500]
    """
    decades = (factor * 10**power for power in range(len(str(budget))) for factor in (1, 3))
    return [mark for mark in decades if mark < budget] + [budget]


def frames(
    first: int, before: Float32 | None, batch: Float32, improved: Sequence[int], budget: int
) -> Iterator[tuple[int, Float32]]:
    """Marks that a piece of candidates passes, each with the best image (H, W, 3) by then.

    first: renders before the piece; before: best image before the piece, or None.
    batch: images of the piece, (n, H, W, 3); improved: indices of images that were the best so far.
    """
    for mark in marks(budget):
        if first < mark <= first + len(batch):
            better = [i for i in improved if first + i < mark]
            image = batch[better[-1]] if better else before
            if image is not None:
                yield mark, image
