"""Pictures that `fide fit` reads: targets, masks, weights; and the range of their values."""

from __future__ import annotations

from typing import Any, NamedTuple

from fide_plugins.errors import ImageError, OptionError

__all__ = ["Pictures", "pictures", "value_range_of"]


class Pictures(NamedTuple):
    """What `FIDE` takes, with the values that the files have.

    targets: (H, W) or (H, W, C) each.
    mask, weights: of one target, or a list of them, one for each; None where none are given.
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
        "alpha" for that of each, a single file for all targets of one size.
    raw: whether numbers are taken as they are stored.

    Raises OptionError unless there is one for each target, ImageError for a target without alpha.
    """
    from fide_plugins.validation.image_files import read_pixels

    if mask is None and weights is None:
        return Pictures([read_pixels(path, side, raw=raw) for path in paths], None, None)
    targets = [read_pixels(path, None, raw=raw) for path in paths]
    masks, others = (_each(*one, targets) for one in (("mask", mask), ("weights", weights)))
    views = [
        _view(path, target, side, raw, {"mask": first, "weights": second})
        for path, target, first, second in zip(paths, targets, masks, others, strict=True)
    ]
    return Pictures(
        [target for target, _, _ in views],
        _joined([one for _, one, _ in views]),
        _joined([one for _, _, one in views]),
    )


def _each(name: str, given: list[str] | None, targets: list[Any]) -> list[Any]:
    """Mask or weights of each target, None for none; raises OptionError."""
    from fide_plugins.views.given import one_a_view

    try:
        several = given is None or len(given) > 1
        return one_a_view(name, given if several else given[0], targets)  # type: ignore[index]
    except ImageError as error:
        assert given is not None
        of = " of different sizes" if len(given) == 1 else ""
        raise OptionError(
            f"{len(given)} of --{name} for {len(targets)} targets{of}; give --{name} once for each"
        ) from error


def _view(path: str, target: Any, side: int | None, raw: bool, given: dict[str, Any]) -> Any:
    """Target, mask and weights of one view.

    given: the files of "mask" and "weights", "alpha" or None.  Those of the target's size say what
    counts where it is made smaller; another one may have the smaller size.
    """
    from fide_plugins.validation.image_files import read_pixels, shrunk
    from fide_plugins.validation.images import alpha_of
    from fide_plugins.views.weights import ALPHA, joined, read_weights

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
                weights = read_weights(pixels, target, size, name)
                product = joined(product, weights, "mask times weights")
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
