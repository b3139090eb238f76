"""Every error the library raises on purpose: a `FideError`, and the builtin exception that fits."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

__all__ = [
    "CheckpointError",
    "DependencyError",
    "DeviceError",
    "DeviceMemoryError",
    "FeaturesError",
    "FideError",
    "ImageError",
    "ImageNotFoundError",
    "LossError",
    "ModelNotFoundError",
    "OptimizerError",
    "OptionError",
    "PointsError",
    "ProtocolError",
    "RenderError",
    "SpaceError",
    "UnknownNameError",
    "ValueRangeError",
    "WeightsError",
    "WeightsMismatchError",
    "WeightsNotFoundError",
]


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """End of a message about a name that is not known: the closest one, if any is close."""
    close = get_close_matches(str(name), list(known), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


class FideError(Exception):
    """Base of every error raised on purpose by this library."""


class ImageError(FideError, ValueError):
    """A target or a batch of images has the wrong shape, type or values."""


class ImageNotFoundError(ImageError, FileNotFoundError):
    """A path given as an image leads to no file."""


class ValueRangeError(ImageError):
    """Renders are on another scale than the target, or whole numbers, whose scale is unknown."""


class FeaturesError(FideError, ValueError):
    """Features of images have the wrong shape, type or values."""


class PointsError(FideError, ValueError):
    """Points of the unit cube have the wrong shape, type or values."""


class LossError(FideError, ValueError):
    """Loss values have the wrong number, type or values."""


class OptionError(FideError, ValueError):
    """An option is unknown, out of its range, or contradicts another."""


class SpaceError(OptionError):
    """A parameter, or a value given for one, is not what it must be."""


class UnknownNameError(OptionError):
    """A name is in no registry."""

    @classmethod
    def of(cls, kind: str, name: object, known: Iterable[str]) -> UnknownNameError:
        """Error for `name`, which is no `kind`; lists the `known` names and the closest one."""
        names = sorted(known)
        hint = did_you_mean(name, names)
        return cls(f"unknown {kind} {name!r}: known are {', '.join(names) or 'none'}{hint}")


class ProtocolError(FideError, RuntimeError):
    """Methods were called in an order that has no meaning, such as `recommend` before `tell`."""


class OptimizerError(FideError, RuntimeError):
    """An optimizer of another library failed by itself."""


class RenderError(FideError, RuntimeError):
    """The user's renderer failed."""


class DeviceError(FideError, ValueError):
    """A compute device is unknown or absent from this machine."""


class DeviceMemoryError(FideError, RuntimeError):
    """A compute device has too little memory for what is asked."""


class DependencyError(FideError, ImportError):
    """An optional package is needed and not installed."""


class ModelNotFoundError(FideError, FileNotFoundError):
    """There is no file of a learned model at the path."""


class WeightsError(FideError, OSError):
    """Base of what can be wrong with a file of network weights."""


class WeightsNotFoundError(WeightsError, FileNotFoundError):
    """A file of network weights is not where it was looked for."""


class WeightsMismatchError(WeightsError, ValueError):
    """A file of network weights is damaged or belongs to another network."""


class CheckpointError(FideError, ValueError):
    """A checkpoint is cut short, damaged, of another version or of another kind."""
