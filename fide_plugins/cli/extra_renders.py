"""Renders outside of the loop of a fit: the first one, and those of further solutions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_plugins.errors import ImageError, RenderError
from fide_plugins.fitting.pictures import as_told, canonical
from fide_plugins.fitting.rendering import Failed, Outcome, Rendered, Renderer
from fide_plugins.fitting.workers import gathered, workers_for
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.images import as_batch
from fide_plugins.validation.options import seconds_of

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE

__all__ = ["check_first", "outcomes"]

_PLACES = 24  # random ones that are rendered if the first one fails


def check_first(
    render: Callable[[Any], object],
    optimizer: FIDE,
    targets: Sequence[Float32],
    names: Sequence[str],
    workers: int,
    timeout: float | str | None,
) -> None:
    """Render where the search begins, as a fit would render it, and check the images.

    If that fails, and not by an error that other parameters hardly mend, random places are tried;
    the search then begins at the first that gives an image.

    targets: (H, W, 3), one for each view; names: of the targets, for messages.
    workers, timeout: as for `fit`.

    Raises RenderError if there is no image, ImageError (a ValueError) for what `FIDE.tell` refuses:
    not one of the target's size for each view, or impossible values.
    """
    x = optimizer.state.search.mean
    (outcome,) = outcomes(render, optimizer, x[None], min(workers, 1), timeout)
    if isinstance(outcome, Failed):
        x, outcome = _elsewhere(render, optimizer, outcome, workers, timeout)
        optimizer.begin_at(x)
    try:
        canonical(optimizer, outcome.image)
    except ImageError as error:
        _compare_sizes(targets, names, as_told(optimizer, outcome.image))
        raise type(error)(f"the first render gave no image that fits: {error}") from error


def _elsewhere(
    render: Callable[[Any], object],
    optimizer: FIDE,
    first: Failed,
    workers: int,
    timeout: float | str | None,
) -> tuple[Float64, Rendered]:
    """A place (d,) that can be rendered, with its image; raises RenderError if none is found."""
    if first.broken:
        raise RenderError(f"the first render failed: {_shown(first)}")
    at_once = max(1, workers)
    for begun in range(0, _PLACES, at_once):
        X = np.array([optimizer.random_point(begun + i) for i in range(at_once)])
        for x, outcome in zip(X, outcomes(render, optimizer, X, workers, timeout), strict=True):
            if isinstance(outcome, Rendered):
                return x, outcome
    raise RenderError(
        f"the first render failed, and so did those of {_PLACES} random places. If most parameters "
        "are invalid, say in the space which are valid: [constraints], and below it wall = "
        f'"inner < 0.6 * outer". The first one: {_shown(first)}'
    )


def outcomes(
    render: Callable[[Any], object],
    optimizer: FIDE,
    X: Float64,
    workers: int,
    timeout: float | str | None,
) -> list[Outcome]:
    """Outcomes of rendering points X (n, dim); arguments as for `fit`.

    The start of a worker is no time of its render, as in `fit`.
    """
    renderer = Renderer(render, optimizer.space, raw=optimizer.value_range is not None)
    limit = None if timeout is None else seconds_of("timeout", timeout)
    pool = workers_for(renderer, workers, None, limit)
    try:
        return list(gathered(pool, X, limit))
    finally:
        pool.close()


def _shown(failed: Failed) -> str:
    """All that is known, once: a traceback ends with the reason."""
    told = failed.reason in failed.details
    return failed.details if told else f"{failed.reason}\n{failed.details}".rstrip()


def _compare_sizes(targets: Sequence[Float32], names: Sequence[str], told: Sequence[Any]) -> None:
    """Raise ImageError, with the remedy, for an image of another size than its target's.

    told: an image of each view, as `as_told` gave it.
    """
    images = told if len(targets) == 1 else [batch[0] for batch in told]
    for target, name, image in zip(targets, names, images, strict=True):
        try:
            found = as_batch([image], on_clip=lambda message: None).shape[1:3]
        except ImageError:  # not of its size, then
            continue
        _check_size(target.shape[:2], found, name)


def _check_size(target: tuple[int, ...], image: tuple[int, ...], name: str) -> None:
    if target != image:
        raise ImageError(
            f"{name} has {target[1]} x {target[0]} pixels, and the renderer's image has "
            f"{image[1]} x {image[0]}; render at the target's size, or reduce the target (--size "
            "is its longer side)"
        )
