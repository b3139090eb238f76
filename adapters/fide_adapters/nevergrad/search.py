"""The FIDE of a Nevergrad optimizer: made with the first candidate, and dumped without images.

Nevergrad makes many optimizers only to inspect them, lets users seed them afterwards, and pickles
them.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_adapters.image_loss import ImageReader, Result, views_of
from fide_adapters.nevergrad.parametrization import Cube
from fide_plugins.errors import ImageError, LossError, ProtocolError
from fide_plugins.types import Float32, Float64
from fide_plugins.views import Views

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE

_NO_TARGET = np.zeros((1, 1, 3), np.float32)  # no image is compared with it
_MOST_OBJECTIVES = 15  # as benchmarks have them; the time of a hypervolume grows exponentially


class TargetImage:
    """A target as a setting, which Nevergrad compares and prints."""

    def __init__(self, views: Views) -> None:
        self.views = views

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TargetImage) and repr(self) == repr(other)

    def __hash__(self) -> int:
        return hash(repr(self))

    def __repr__(self) -> str:
        views = self.views
        content = views.target.tobytes() + views.version.encode()
        content += b"" if views.values is None else repr(views.values).encode()
        return f"<{views.sizes} {hashlib.sha256(content).hexdigest()[:16]}>"


def target_setting(
    target: object, mask: object, weights: object, value_range: object
) -> TargetImage | None:
    """The setting `target` with its mask, weights and range of values; raises ImageError."""
    if isinstance(target, TargetImage):  # of another configuration
        target = target.views
    views = views_of(target, mask, weights, value_range)
    return None if views is None else TargetImage(views)


class Search:
    """FIDE with the settings of a `ParametrizedFIDE`.

    workers: number of candidates that are evaluated at the same time; a generation has no fewer.
    """

    def __init__(self, settings: Mapping[str, Any], workers: int) -> None:
        self._settings, self._workers = settings, workers
        self.num_images = 0
        """Candidates told with an image."""
        self._num_losses = 0  # valid candidates told without
        self._fide: FIDE | None = None
        self._snapshot: dict[str, Any] | None = None  # of the FIDE to restore
        self.set_target(None if settings["target"] is None else settings["target"].views)

    def set_target(self, target: Views | None) -> None:
        """Targets and weights of the views; raises ProtocolError once the search has begun."""
        if self.started:
            raise ProtocolError(
                "the target cannot be changed after the search has begun; set it before the first "
                "ask or tell, or make another optimizer and tell it the known results"
            )
        self.target = target
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
        size = size or default_popsize(max(1, 0 if cube.space is None else cube.space.dim))
        if self.target is None:
            options = without_images(options)
        options = {"memory_mb": 0.0, **options}  # for the next target, which there never is
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

    def check(self, result: Result) -> tuple[Any, Float32 | None]:
        """Loss as Nevergrad takes it, and image (1, H, W, 3) of a result; the search has begun.

        Raises ImageError or LossError, both ValueErrors, before anything changes.
        """
        loss, batch = result.loss, None
        if self._read is not None:
            if _count(loss) > _MOST_OBJECTIVES:
                raise ImageError(
                    f"with a target a result is a loss, up to {_MOST_OBJECTIVES} losses of several "
                    f"objectives, or an image, not {_count(loss)} numbers: return an image (H, W) "
                    "or (H, W, C) as an array with all its axes, or the pair (loss, image)"
                )
            if result.image is not None:
                batch = self._read(result.image)
                if loss is None:
                    loss = float(self.fide.evaluator.evaluate(1, batch, encode=False).losses[0])
        if loss is None:
            raise LossError(
                "a candidate is told with its loss, or with an image for a target: set "
                "optimizer.target before the first ask, or tell the loss"
            )
        # Nevergrad replaces +inf and NaN, but takes -inf for the best loss of all, and in an array
        # of one number it replaces nothing
        if isinstance(loss, list | tuple | np.ndarray) and _count(loss) == 1:
            loss = np.ravel(loss)[0]
        return math.inf if isinstance(loss, Real) and not math.isfinite(loss) else loss, batch

    def tell(self, x: Float64, loss: float, batch: Float32 | None, valid: bool) -> None:
        """Report point x (d,) with its loss, including penalties.

        valid: False where no image was to be had: the render failed, or a constraint is violated.
        """
        self.fide.tell(x[None], batch, [loss])
        self.num_images += batch is not None
        self._num_losses += valid and batch is None

    @property
    def lacks_images(self) -> bool:
        """Whether as many valid candidates as a generation has were told, and no image at all."""
        return self.num_images == 0 and self._num_losses >= self.fide.popsize

    def __getstate__(self) -> dict[str, Any]:
        state = {**self.__dict__, "_fide": None}
        if self._fide is not None:
            from fide_plugins.saving import as_arrays

            snapshot = self._fide.snapshot()
            del snapshot["settings"]["target"], snapshot["settings"]["weights"]  # which this has
            if snapshot["state"]["best"] is not None:
                snapshot["state"]["best"]["solution"]["image"] = None
            state["_snapshot"] = as_arrays(snapshot)
        return state


def _count(loss: Any) -> int:
    """Number of numbers in a loss, in arrays and nested lists of any shape."""
    if isinstance(loss, list | tuple):
        return sum(_count(one) for one in loss)
    return math.prod(np.shape(loss))
