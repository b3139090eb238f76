"""What `fide fit` reads before the search: pictures, their weights and range of values."""

from __future__ import annotations

from typing import Any

from fide_plugins.errors import OptionError
from fide_plugins.validation.image_files import read_pixels, shrunk
from fide_plugins.views.views import joined, one_a_view, read_weights


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

    mask, weights: a file or "alpha" for each target, or for all.  raw: numbers as they are stored.
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
