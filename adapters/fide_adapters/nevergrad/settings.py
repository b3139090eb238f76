"""The settings of a `ParametrizedFIDE`, as Nevergrad compares and prints them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

from fide_plugins.errors import OptionError
from fide_plugins.validation.options import check_names
from fide_plugins.views import Views
from fide_plugins.views.views import views_of

__all__ = ["TargetImage", "check_options", "target_setting"]

_ARGUMENTS = (
    *("target", "mask", "weights", "value_range"),
    *("loss", "preset", "encoder", "popsize", "device", "seed"),
)


class TargetImage:
    """A target as a setting: comparable, and with a short name.

    image, mask, weights, value_range: anything that `fide_plugins.FIDE` takes.
    views: what they are; its arrays are read-only.
    """

    def __init__(
        self,
        image: object,
        mask: object = None,
        weights: object = None,
        value_range: object = None,
    ) -> None:
        self.views = Views.read(image, mask, weights, value_range)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TargetImage) and repr(self) == repr(other)

    def __hash__(self) -> int:
        return hash(repr(self))

    def __repr__(self) -> str:
        views = self.views
        content = views.target.tobytes() + views.version.encode()
        content += b"" if views.values is None else repr(views.values).encode()
        return f"<{views.sizes} {hashlib.sha256(content).hexdigest()[:16]}>"


def check_options(options: object) -> None:
    """Raise OptionError for what is no mapping, or names what has another place."""
    if options is not None and not isinstance(options, Mapping):
        raise OptionError(f"options must be a dictionary of options by name, not {options!r}")
    instead = "is an argument of its own: give it as one, not in options"
    check_names(options or {}, _ARGUMENTS, instead)
    instead = "is a property of the parametrization: set its init and its sigma"
    check_names(options or {}, ("x0", "sigma0"), instead)


def target_setting(
    target: object, mask: object, weights: object, value_range: object
) -> TargetImage | None:
    """The setting `target` with its mask, weights and range of values; raises ImageError."""
    if isinstance(target, TargetImage) and mask is None and weights is None and value_range is None:
        return target
    views = views_of(target, mask, weights, value_range)
    return None if views is None else TargetImage(views)
