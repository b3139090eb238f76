"""Pictures that `fide fit` reads: targets, masks, weights."""

from __future__ import annotations

from typing import Any

from fide_plugins.errors import ImageError, OptionError

__all__ = ["pictures", "weights_of"]


def pictures(paths: list[str], side: int | None) -> list[Any]:
    """Pictures (H, W, 3) of files, the longer side at most `side`."""
    from fide_plugins.validation import images

    return [images.load(path, max_side=side) for path in paths]


def weights_of(
    name: str, given: list[str] | None, paths: list[str], targets: list[Any], side: int | None
) -> Any:
    """What `FIDE` takes as `mask` or `weights`; None if none are given.

    name: "mask" or "weights".  given: a file for each target, or "alpha" for the target's own alpha
    channel; a single "alpha" for that of each, a single file for all targets of one size.
    paths, targets: files of the targets, and what `pictures` read of them.

    Raises OptionError unless there is one for each target, ImageError for a target without alpha.
    """
    from fide_plugins.validation.image_files import read_pixels
    from fide_plugins.views.given import one_a_view
    from fide_plugins.views.weights import ALPHA

    if given is None:
        return None
    try:
        each: list[Any] = one_a_view(name, given[0] if len(given) == 1 else given, targets)
    except ImageError as error:
        of = " of different sizes" if len(given) == 1 else ""
        raise OptionError(
            f"{len(given)} of --{name} for {len(paths)} targets{of}; give --{name} once for each"
        ) from error
    read = [  # pixels as they are: what transparency means is known where the mask is used
        _alpha_of(path, side, name) if one == ALPHA else read_pixels(one, side)
        for one, path in zip(each, paths, strict=True)
    ]
    return read[0] if len(read) == 1 else read


def _alpha_of(target: str, side: int | None, name: str) -> Any:
    """Alpha channel (H, W) of a file; ImageError names the other remedy, an argument `name`."""
    from fide_plugins.validation.image_files import read_pixels
    from fide_plugins.validation.images import alpha_of

    pixels = read_pixels(target, side)
    try:
        return alpha_of(pixels, target)
    except ImageError as error:
        raise ImageError(f"{error}; or give a picture, --{name} FILE") from error
