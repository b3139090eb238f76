"""The settings of a Nevergrad optimizer, and its FIDE: made late, and dumped without images.

Nevergrad makes many optimizers only to inspect them, lets users seed an optimizer after it was
made, and dumps optimizers by pickling.  So FIDE is made, and PyTorch imported, with the first
candidate; and a dump holds FIDE's state as arrays, without images, encoder and networks.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from numbers import Real
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fide_adapters.image_loss import ImageReader, Result
from fide_adapters.nevergrad.parametrization import Cube
from fide_plugins.errors import ImageError, LossError, OptionError, ProtocolError
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.options import check_names
from fide_plugins.views import Views
from fide_plugins.views.views import views_of

if TYPE_CHECKING:
    from torch import Tensor

    from fide_plugins.fide import FIDE

__all__ = ["Evaluation", "Search", "TargetImage", "check_options", "target_setting"]

_NO_TARGET = np.zeros((1, 1, 3), np.float32)  # no image is compared with it
_MOST_OBJECTIVES = 15  # as benchmarks have them; the time of a hypervolume grows exponentially
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


class Evaluation(NamedTuple):
    """A checked result of a candidate.

    loss: as it goes to Nevergrad, which checks it; infinity for one that is not finite.
    batch: image (1, H, W, 3).
    features: tokens (1, T, C), in place of an image.
    """

    loss: Any
    batch: Float32 | None = None
    features: Tensor | None = None

    @property
    def has_image(self) -> bool:
        """Whether there is an image, or features of one."""
        return self.batch is not None or self.features is not None


class Search:
    """FIDE with the settings of a `ParametrizedFIDE`.

    settings: its configuration.
    target: targets and weights of the views, or None.
    workers: number of candidates that are evaluated at the same time; a generation has no fewer.
    """

    def __init__(self, settings: Mapping[str, Any], target: Views | None, workers: int) -> None:
        self._settings, self._workers = settings, workers
        self.num_images = 0
        """Candidates told with an image or features."""
        self._num_losses = 0  # valid candidates told without
        self._fide: FIDE | None = None
        self._snapshot: dict[str, Any] | None = None  # of the FIDE to restore
        self.target = target

    @property
    def target(self) -> Views | None:
        """Targets and weights of the views."""
        return self._target

    @target.setter
    def target(self, target: Views | None) -> None:
        if self.started:
            raise ProtocolError(
                "the target cannot be changed after the search has begun; set it before the first "
                "ask or tell, or make another optimizer and tell it the known results"
            )
        self._target = target
        self._read = None if target is None else ImageReader(target)

    @property
    def started(self) -> bool:
        """Whether the search has begun."""
        return self._fide is not None or self._snapshot is not None

    def start(self, cube: Cube, rng: np.random.RandomState) -> None:
        """Make FIDE, with the seed of the settings or one from `rng`."""
        from fide_plugins.fide import FIDE
        from fide_plugins.options import make_options, without_images
        from fide_plugins.search.cma_es import default_popsize

        s = self._settings
        options = {**(s["options"] or {}), "encoder": s["encoder"]}
        size = make_options(s["preset"], {**options, "popsize": s["popsize"]}).popsize
        if self.target is None:
            options = without_images(options)
        options = {"memory_mb": 0.0, **options}  # for the next target, which there never is
        dim = 0 if cube.space is None else cube.space.dim
        size = size or default_popsize(max(1, dim))
        self._fide = FIDE(
            cube.space or 0,  # which is refused
            _NO_TARGET if self.target is None else self.target.canonical,  # `_read` scales images
            loss=None if self.target is None else s["loss"],
            popsize=max(size, self._workers),
            x0=cube.guess,
            sigma0=cube.std,
            preset=s["preset"],
            seed=int(rng.randint(2**63, dtype=np.int64)) if s["seed"] is None else s["seed"],
            device=s["device"],
            **options,
        )

    @property
    def fide(self) -> FIDE:
        """The FIDE of this search, which must have begun; made again after a dump was loaded."""
        if self._fide is None:
            if self._snapshot is None:
                raise ProtocolError("the search begins with the first ask or tell")
            from fide_plugins.fide import FIDE

            known = self.target is not None
            target = _NO_TARGET if self.target is None else self.target.canonical
            settings = {**self._snapshot["settings"], "target": target, "weights": None}
            snapshot = {**self._snapshot, "settings": settings}
            loss = self._settings["loss"] if known else None
            self._fide = FIDE.restore(snapshot, loss, self._settings["device"])
            self._snapshot = None
        return self._fide

    # -- results -----------------------------------------------------------------------------------

    def check(self, result: Result) -> Evaluation:
        """Check a result before anything changes; the search must have begun.

        Raises
        ------
        ImageError, FeaturesError, LossError
            all ValueErrors: the image or the features are not valid, a loss is missing, or there
            are as many losses as a flat image has values.
        """
        if result.image is not None and result.features is not None:
            raise ImageError("a candidate is told with its image or with features, not with both")
        if self.target is not None:
            _refuse_flat_image(result, self.target)
        evaluation = self._evaluate(result)
        return evaluation._replace(loss=_as_ranked(evaluation.loss))

    def _evaluate(self, result: Result) -> Evaluation:
        if self._read is None:
            if result.loss is None:
                raise LossError(
                    "a loss of images needs a target: set optimizer.target before the first ask, "
                    "or tell the loss with the image"
                )
            return Evaluation(result.loss)
        if result.features is not None:
            if result.loss is None:
                raise LossError("features must be told with a loss")
            return Evaluation(result.loss, features=self._check_features(result))
        if result.image is None:
            return Evaluation(result.loss)
        batch, loss = self._read(result.image), result.loss
        if loss is None:
            loss = float(self.fide.evaluator.evaluate(1, batch, encode=False).losses[0])
        return Evaluation(loss, batch)

    def _check_features(self, result: Result) -> Tensor:
        import torch

        from fide_plugins.validation.tensors import as_features

        fide, device = self.fide, torch.device("cpu")  # FIDE moves them to its own device
        shape = (1, *fide.features_shape)
        return as_features(
            [result.features], shape, fide.encoder, version=result.version, device=device
        )

    def tell(self, x: Float64, loss: float, evaluation: Evaluation, valid: bool) -> None:
        """Report point x (d,) with its loss, including penalties.

        valid: False where no image was to be had: the render failed, or a constraint is violated.
        """
        self.fide.tell(x[None], evaluation.batch, [loss], features=evaluation.features)
        self.num_images += evaluation.has_image
        self._num_losses += valid and not evaluation.has_image

    @property
    def lacks_images(self) -> bool:
        """Whether as many valid candidates as a generation has were told, and no image at all."""
        return self.num_images == 0 and self._num_losses >= self.fide.popsize

    # -- dump --------------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        state = {**self.__dict__, "_fide": None}
        if self._fide is not None:
            from fide_plugins.saving import as_arrays

            snapshot = self._fide.snapshot()
            del snapshot["settings"]["target"], snapshot["settings"]["weights"]  # which this has
            if snapshot["state"]["best"] is not None:
                snapshot["state"]["best"]["image"] = None
            state["_snapshot"] = as_arrays(snapshot)
        return state


def _refuse_flat_image(result: Result, target: Views) -> None:
    """Raise ImageError for an image without its axes, whose values would be objectives."""
    n = _count(result.loss)
    is_alone = result.image is None and result.features is None
    sizes = {math.prod(view.size) * channels for view in target.views for channels in (1, 3, 4)}
    if n == 1 or (n <= _MOST_OBJECTIVES and not (is_alone and n in sizes)):
        return
    raise ImageError(
        f"with a target of {target.sizes} a result is a loss, up to {_MOST_OBJECTIVES} losses of "
        "several objectives, or an image of shape (H, W) or (H, W, C), not a "
        f"{type(result.loss).__name__} of {n} numbers: return the image as an array with all its "
        "axes, or the pair (loss, image)"
    )


def _as_ranked(loss: Any) -> Any:
    """A loss with which Nevergrad ranks failures last, as FIDE does.

    Nevergrad replaces +inf and NaN, but takes -inf for the best loss of all, and in an array of one
    number it replaces nothing.
    """
    if isinstance(loss, list | tuple | np.ndarray) and _count(loss) == 1:
        loss = np.ravel(loss)[0]
    return math.inf if isinstance(loss, Real) and not math.isfinite(loss) else loss


def _count(loss: Any) -> int:
    """Number of numbers in a loss, in arrays and nested lists of any shape."""
    if isinstance(loss, list | tuple):
        return sum(_count(one) for one in loss)
    return math.prod(np.shape(loss))
