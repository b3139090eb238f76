"""What `fide fit` reads and renders before the search: pictures, and the first image."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from fide_plugins.errors import ImageError, OptionError, RenderError
from fide_plugins.fitting.fidelity import Fidelity, schedule_for
from fide_plugins.fitting.pictures import canonical
from fide_plugins.fitting.rendering import Outcome, Rendered, Renderer
from fide_plugins.fitting.workers import gathered, workers_for
from fide_plugins.types import Float64
from fide_plugins.validation.image_files import read_pixels, shrunk
from fide_plugins.validation.options import seconds_of
from fide_plugins.views.views import joined, one_a_view, read_weights

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE


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
) -> tuple[list[Any], list[Any]]:
    """Targets (H, W) or (H, W, C), the longer side at most `side`, and weights (H, W) of each.

    mask, weights: a file for each target, or "alpha" for the target's own alpha channel; a single
    one for all targets.  raw: whether numbers are taken as they are stored.

    Raises ImageError: another number of them, or another size than the target's.
    """
    if mask is None and weights is None:
        return [read_pixels(path, side, raw=raw) for path in paths], [None] * len(paths)
    whole = [read_pixels(path, None, raw=raw) for path in paths]
    given = {"mask": mask, "weights": weights}
    masks, others = (
        one_a_view(name, files[0] if files and len(files) == 1 else files, whole)
        for name, files in given.items()
    )
    targets, counting = [], []
    for target, first, second in zip(whole, masks, others, strict=True):
        size = target.shape[:2]
        first, second = (
            read_weights(one, target, size, name)
            for name, one in zip(given, (first, second), strict=True)
        )
        product = joined(first, second, "mask times weights")
        small, less = shrunk(target, product, side, raw=raw)
        targets.append(small)
        counting.append(less)
    return targets, counting


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

    def check_first(self, optimizer: FIDE) -> None:
        """Render where the search begins, and check the images.

        Raises RenderError for an error that other parameters hardly mend, ImageError (a ValueError)
        for images that `FIDE.tell` refuses.  Other failures are left to the search.
        """
        (outcome,) = self(optimizer, optimizer.state.search.mean[None])
        if isinstance(outcome, Rendered):
            try:
                canonical(optimizer, outcome.image)
            except ImageError as error:
                raise type(error)(f"the first render gave no image that fits: {error}") from error
        elif outcome.broken:
            told = outcome.reason in outcome.details  # a traceback ends with the reason
            shown = outcome.details if told else f"{outcome.reason}\n{outcome.details}".rstrip()
            raise RenderError(f"the first render failed: {shown}")
