"""FIDE as an optimizer for Nevergrad; see `docs/reference/nevergrad.md`.

Importing this module registers the name FIDE, also if it is imported again, and changes no other.
"""

from __future__ import annotations

from fide_plugins.runtime.machine import missing

try:
    from nevergrad.optimization.base import registry
except ImportError as error:
    raise missing("nevergrad", "fide_adapters.nevergrad needs Nevergrad") from error

from fide_adapters.image_loss import ImageLoss
from fide_adapters.nevergrad.optimizer import NoImagesWarning, ParametrizedFIDE

__all__ = ["FIDE", "ImageLoss", "NoImagesWarning", "ParametrizedFIDE"]


def _registered() -> ParametrizedFIDE:
    """The optimizer in the registry; registers it if it is not there."""
    known = registry.get("FIDE")
    if isinstance(known, ParametrizedFIDE):
        return known
    if type(known).__module__ == ParametrizedFIDE.__module__:  # of an earlier import
        registry.unregister("FIDE")
    made: ParametrizedFIDE = ParametrizedFIDE().set_name("FIDE", register=True)
    return made


FIDE = _registered()
"""`ParametrizedFIDE` with its default settings, as it is in the registry."""
