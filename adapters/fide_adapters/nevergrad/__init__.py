"""FIDE as an optimizer for Nevergrad.

    import nevergrad as ng
    from fide_adapters.nevergrad import ImageLoss, ParametrizedFIDE  # registers "FIDE"

    def objective(x):
        image = render(x)
        return ImageLoss(float(((image - target) ** 2).mean()), image)  # or just the image

    parametrization = ng.p.Array(shape=(40,), lower=0, upper=1)
    optimizer = ng.optimizers.registry["FIDE"](parametrization, budget=5000, num_workers=4)
    optimizer.target = target  # or ParametrizedFIDE(target=target, ...)(parametrization, ...)
    best = optimizer.minimize(objective, executor=executor).value

Importing this module registers the name FIDE, also if it is imported again, and changes no other.
"""

from __future__ import annotations

from fide_plugins.runtime.machine import missing

try:
    from nevergrad.optimization.base import registry
except ImportError as error:
    raise missing("nevergrad", "fide_adapters.nevergrad needs Nevergrad") from error

from fide_adapters.image_loss import ImageLoss, ImageRef
from fide_adapters.nevergrad.optimizer import IMAGE, DaskExecutor, NoImagesWarning, ParametrizedFIDE

__all__ = [
    "FIDE",
    "IMAGE",
    "DaskExecutor",
    "ImageLoss",
    "ImageRef",
    "NoImagesWarning",
    "ParametrizedFIDE",
]

_NAME = "FIDE"


def _registered() -> ParametrizedFIDE:
    """The optimizer in the registry; registers it if it is not there."""
    known = registry.get(_NAME)
    if isinstance(known, ParametrizedFIDE):
        return known
    if (
        type(known).__module__ == ParametrizedFIDE.__module__
    ):  # of an earlier import of this package
        registry.unregister(_NAME)
    made: ParametrizedFIDE = ParametrizedFIDE().set_name(_NAME, register=True)
    return made


FIDE = _registered()
"""`ParametrizedFIDE` with its default settings, as it is in the registry."""
