"""What `fide fit` reads and renders before the search: pictures, and the first image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fide_plugins.errors import ImageError, OptionError, RenderError
from fide_plugins.fitting.fidelity import Fidelity, schedule_for
from fide_plugins.fitting.pictures import as_told, canonical
from fide_plugins.fitting.rendering import Failed, Outcome, Rendered, Renderer
from fide_plugins.fitting.workers import gathered, workers_for
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.images import as_batch
from fide_plugins.validation.options import seconds_of

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE


class Pictures(NamedTuple):
    """What `FIDE` takes, with the values that the files have.

    targets: (H, W) or (H, W, C) each.  mask, weights: of one target, a list for several, or None.
    """

    targets: list[Any]
    mask: Any
    weights: Any


def value_range_of(words: list[str] | None) -> str | tuple[float, float] | None:
    """What --value-range says: "auto", two numbers, also as LOW,HIGH; OptionError otherwise."""
    if words is None:
        return None
    parts = " ".join(words).replace(",", " ").split()
    if parts == ["auto"]:
        return "auto"
    try:
        low, high = map(float, parts)
    except ValueError:
        raise OptionError(
            f"--value-range is two numbers, such as 0 10, or auto, not {' '.join(words)!r}; before "
            "a TARGET, or for a negative number, write --value-range=-1,1"
        ) from None
    return low, high


def pictures(
    paths: list[str],
    side: int | None,
    mask: list[str] | None,
    weights: list[str] | None,
    *,
    raw: bool = False,
) -> Pictures:
    """Read targets, masks and weights; the longer side at most `side`, reduced together.

    mask, weights: a file for each target, or "alpha" for the target's own alpha channel; a single
    one for all targets.  raw: whether numbers are taken as they are stored.

    Raises OptionError unless there is one for each target, ImageError for a target without alpha.
    """
    from fide_plugins.validation.image_files import read_pixels

    if mask is None and weights is None:
        return Pictures([read_pixels(path, side, raw=raw) for path in paths], None, None)
    targets = [read_pixels(path, None, raw=raw) for path in paths]
    masks, others = (_each(*one, targets) for one in (("mask", mask), ("weights", weights)))
    views = [_view(*one, side, raw) for one in zip(paths, targets, masks, others, strict=True)]
    targets, mask_of_each, weights_of_each = map(list, zip(*views, strict=True))
    return Pictures(targets, _joined(mask_of_each), _joined(weights_of_each))


def _each(name: str, given: list[str] | None, targets: list[Any]) -> list[Any]:
    """Mask or weights of each target, None for none; raises OptionError."""
    from fide_plugins.views.views import one_a_view

    try:
        several = given is None or len(given) > 1
        return one_a_view(name, given if several else given[0], targets)  # type: ignore[index]
    except ImageError as error:
        assert given is not None
        of = " of different sizes" if len(given) == 1 else ""
        raise OptionError(
            f"{len(given)} of --{name} for {len(targets)} targets{of}; give --{name} once for each"
        ) from error


def _view(path: str, target: Any, mask: Any, weights: Any, side: int | None, raw: bool) -> Any:
    """Target, mask and weights of one view, of which those are files, "alpha" or None.

    Those of the target's size say what counts where it is made smaller; another one may have the
    smaller size.
    """
    from fide_plugins.validation.image_files import read_pixels, shrunk
    from fide_plugins.validation.images import alpha_of
    from fide_plugins.views.views import ALPHA, joined, read_weights

    given = {"mask": mask, "weights": weights}
    size, product, counting = target.shape[:2], None, []
    for name, one in given.items():
        if one == ALPHA:
            try:
                alpha_of(target, path)
            except ImageError as error:
                raise ImageError(f"{error}; or give a picture, --{name} FILE") from error
        elif one is not None:
            pixels = read_pixels(one, None)
            given[name] = pixels if pixels.shape[:2] == size else read_pixels(one, side)
            if pixels.shape[:2] == size and side is not None and max(size) > side:
                of_pixels = read_weights(pixels, target, size, name)
                product = joined(product, of_pixels, "mask times weights")
                counting.append(name)
    small, less = shrunk(target, product, side, raw=raw)
    if counting:
        given.update(dict.fromkeys(counting))
        given[counting[0]] = less
    return small, given["mask"], given["weights"]


def _joined(each: list[Any]) -> Any:
    """What `FIDE` takes for one view, or a list of them; None if there are none."""
    if all(one is None for one in each):
        return None
    return each[0] if len(each) == 1 else each


# -- renders outside of the loop: the first one, and those of further solutions --------------------

_PLACES = 24  # random ones that are rendered if the first one fails


class Renders:
    """Renders points outside of the loop, as a fit renders them.

    render, workers, timeout: as for `fit`.  samples: most of a pixel; images are the finest.
    """

    def __init__(
        self,
        render: Callable[..., object],
        workers: int,
        timeout: float | str | None,
        samples: int | None = None,
    ) -> None:
        self._render, self._workers = render, workers
        self.fidelity = None if samples is None else Fidelity((32, 2**16), (1, samples))
        self._limit = None if timeout is None else seconds_of("timeout", timeout)

    def __call__(self, optimizer: FIDE, X: Float64) -> list[Outcome]:
        """Outcomes of points (n, dim); the start of a worker is no time of its render."""
        schedule = schedule_for(self._render, self.fidelity, optimizer)
        keywords = {} if schedule is None else schedule.finest()
        raw = optimizer.value_range is not None
        renderer = Renderer(self._render, optimizer.space, raw, keywords)
        pool = workers_for(renderer, min(self._workers, len(X)), None, self._limit)
        try:
            return list(gathered(pool, X, self._limit))
        finally:
            pool.close()

    def check_first(
        self, optimizer: FIDE, targets: Sequence[Float32], names: Sequence[str]
    ) -> None:
        """Render where the search begins, and check the images.

        If that fails, and not by an error that other parameters hardly mend, random places are
        tried; the search then begins at the first that gives an image.

        targets: (H, W, 3), one for each view; names: of the targets, for messages.

        Raises RenderError if there is no image, ImageError (a ValueError) for what `FIDE.tell`
        refuses: not one of the target's size for each view, or impossible values.
        """
        x = optimizer.state.search.mean
        (outcome,) = self(optimizer, x[None])
        if isinstance(outcome, Failed):
            x, outcome = self._at_random(optimizer, outcome)
            optimizer.begin_at(x)
        try:
            canonical(optimizer, outcome.image)
        except ImageError as error:
            _compare_sizes(targets, names, as_told(optimizer, outcome.image))
            raise type(error)(f"the first render gave no image that fits: {error}") from error

    def _at_random(self, optimizer: FIDE, first: Failed) -> tuple[Float64, Rendered]:
        """A place (d,) that can be rendered, with its image; RenderError if none is found."""
        told = first.reason in first.details  # a traceback ends with the reason
        shown = first.details if told else f"{first.reason}\n{first.details}".rstrip()
        if first.broken:
            raise RenderError(f"the first render failed: {shown}")
        at_once = max(1, self._workers)
        for begun in range(0, _PLACES, at_once):
            X = np.array([optimizer.random_point(begun + i) for i in range(at_once)])
            for x, outcome in zip(X, self(optimizer, X), strict=True):
                if isinstance(outcome, Rendered):
                    return x, outcome
        raise RenderError(
            f"the first render failed, and so did those of {_PLACES} random places. If most "
            "parameters are invalid, say in the space which are valid: [constraints], and below it "
            f'wall = "inner < 0.6 * outer". The first one: {shown}'
        )


def _compare_sizes(targets: Sequence[Float32], names: Sequence[str], told: Sequence[Any]) -> None:
    """Raise ImageError, with the remedy, for an image of another size than its target's.

    told: an image of each view, as `as_told` gave it.
    """
    images = told if len(targets) == 1 else [batch[0] for batch in told]
    for target, name, image in zip(targets, names, images, strict=True):
        size = target.shape[:2]
        with suppress(ImageError):  # which is not of its size, then
            size = as_batch([image], on_clip=id).shape[1:3]
        if size != target.shape[:2]:
            width, height, *_ = target.shape[1::-1]
            raise ImageError(
                f"{name} has {width} x {height} pixels, and the renderer's image has "
                f"{size[1]} x {size[0]}; render at the target's size, or reduce the target "
                "(--size is its longer side)"
            )
