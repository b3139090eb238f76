"""Truncated sequential neural posterior estimation, TSNPE (Deistler et al. 2022), by sbi.

Round 1 renders uniform points of the box, and a network learns p(x | image) from them.  Each later
round renders points of the box cut to where the network sees the target's posterior, and training
goes on with all points so far; as they are the prior's, but for the cut, nothing is corrected.
What is left of the budget goes to samples of the posterior.

The network sees an image of at most `size` pixels a side.  Exchangeable blocks are put in one
order, see `canonical`: otherwise the posterior has as many modes as there are orders.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from torch import Tensor

from fide_lab.baselines.images_needed import needed_images, needed_target
from fide_lab.baselines.npe.canonical import canonical
from fide_lab.baselines.npe.flow import Flow, Trainer, import_sbi, seeded
from fide_lab.baselines.npe.truncated import draw_truncated
from fide_lab.baselines.stateful import Stateful
from fide_plugins.errors import OptionError
from fide_plugins.runtime.opencv import cv2
from fide_plugins.runtime.schema import (
    GENERATOR,
    Schema,
    Sides,
    array,
    maybe,
    numbers,
    table,
    whole,
)
from fide_plugins.search.exchangeability import check_groups
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.options import positive, positive_fraction
from fide_plugins.validation.points import whole_number

__all__ = ["NPE"]

LEAST_SIDE = 16  # pixels that the embedding needs
LEAST_POINTS = 20  # for a training


class NPE(Stateful):
    """Neural posterior estimation with truncated proposals; extra `sbi`.

    budget: evaluations that are planned.
    share: fraction of the budget that is spent on points to learn from.
    rounds: trainings.
    popsize: points a round; None: share * budget / rounds.
    epochs: passes over all points so far in each training, at most; at least 2.  A training also
        ends after 20 passes without progress on a tenth of the points that is held out.
    batch_size: points of a step of Adam.
    quantile: mass of the posterior that a truncated proposal leaves out.
    size: pixels of a side of the image that the network sees, at most.
    width, transforms: hidden units and layers of the flow.
    support: samples of the posterior by which its region is found.
    groups: exchangeable blocks of parameters, such as [[0, 1, 2], [3, 4, 5]]; None: there are none.

    It runs on the CPU; points whose loss is no number are not learned from.  The other options are
    those of `Baseline`; `sigma0` is not used.

    Raises OptionError, ImageError without a target (ValueErrors), DependencyError without sbi.
    """

    name: ClassVar[str] = "npe"
    own_schema: ClassVar[dict[str, Schema]] = {
        "trained": whole(),
        "x": array("n", "d", low=0.0, high=1.0),
        "images": array("n", "f"),
        "weights": maybe(table(numbers)),
        "rng": GENERATOR,
    }

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        budget: int = 10_000,
        share: float = 0.8,
        rounds: int = 5,
        popsize: int | None = None,
        epochs: int = 100,
        batch_size: int = 100,
        quantile: float = 1e-3,
        size: int = 32,
        width: int = 50,
        transforms: int = 5,
        support: int = 10_000,
        groups: Sequence[Sequence[int]] | None = None,
        **options: Any,
    ) -> None:
        self.budget = whole_number("budget", budget, 1)
        self.share = positive_fraction("share", share)
        self.quantile = _checked_quantile(quantile)
        self.rounds = whole_number("rounds", rounds, 1)
        super().__init__(dim, target, popsize=popsize, **options)
        image = needed_target(self.name, self.target)
        import_sbi(self.name)
        self.epochs = whole_number("epochs", epochs, 2)
        self.batch_size = whole_number("batch_size", batch_size, 1)
        self.size = whole_number("size", size, LEAST_SIDE)
        self.width = whole_number("width", width, 1)
        self.transforms = whole_number("transforms", transforms, 1)
        self.support = whole_number("support", support, 1)
        self._blocks = None if groups is None else check_groups(groups, self.dim)
        self._start(image)

    def _start(self, target: Float32) -> None:
        """Begin with a network that has learned nothing; target: (H, W, 3)."""
        h, w = target.shape[:2]
        self._shape = self._side(h), self._side(w)
        self._target = self._encode(target[None])
        self._rng = np.random.default_rng(self.seed)
        self._trainer = Trainer(self.dim, self._shape, **self._training())
        self.trained = 0  # rounds whose training is done
        self._x: list[Float64] = []  # learned from, in their canonical order
        self._images: list[Float32] = []

    def _sample(self) -> Float64:
        if not self.trained:
            return self._rng.random((self.popsize, self.dim))  # ~ U(0, 1)
        with self._timed("train"), seeded(self._new_seed()):
            flow = Flow(self._trainer.estimator, self._trainer.images(self._target), self._ordered)
            if self.trained < self.rounds:
                drawn = draw_truncated(
                    self.popsize, self._trainer.prior, flow,
                    order=self._ordered, quantile=self.quantile, support=self.support,
                )  # fmt: skip
            else:
                drawn = flow.sample((self.popsize,))
        return drawn.double().numpy()

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        assert features is not None
        if self.trained == self.rounds:
            return
        good = np.isfinite(losses)
        self._x.extend(canonical(X[good], self._blocks))
        self._images.extend(features[good])
        if len(self._x) < LEAST_POINTS:
            return
        with self._timed("train"), seeded(self._new_seed()):
            self._trainer.fit(np.array(self._x), np.array(self._images))
        self.trained += 1
        if self.trained == self.rounds:
            self._x, self._images = [], []
        self._population.forget_pending()

    def _encode(self, batch: Float32 | None) -> Float32:
        images, (h, w) = needed_images(self.name, batch), self._shape
        small = [cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA) for image in images]
        rows = [image.transpose(2, 0, 1).ravel() for image in small]  # channels first
        return np.array(rows, np.float32).reshape(len(images), 3 * h * w)

    def _side(self, pixels: int) -> int:
        return min(self.size, max(LEAST_SIDE, pixels))

    def _ordered(self, points: Tensor) -> Tensor:
        """Points (n, d) in their canonical order."""
        ordered: Float64 = canonical(points.numpy(), self._blocks)
        return points.new_tensor(ordered)

    def _training(self) -> dict[str, int]:
        names = ("width", "transforms", "epochs", "batch_size")
        return {name: getattr(self, name) for name in names}

    def _new_seed(self) -> int:
        return int(self._rng.integers(2**31))

    def _default_popsize(self) -> int:
        return max(LEAST_POINTS, round(self.share * self.budget / self.rounds))

    def _sides(self) -> Sides:
        return super()._sides() | {"f": self._target.shape[1]}

    def _own_settings(self) -> dict[str, Any]:
        names = ("budget", "share", "rounds", "quantile", "size", "support")
        own = {name: getattr(self, name) for name in names} | self._training()
        groups = None if self._blocks is None else self._blocks.tolist()
        return {**super()._own_settings(), **own, "groups": groups}

    def _own_state(self) -> dict[str, Any]:
        return {
            "trained": self.trained,
            "x": np.array(self._x).reshape(-1, self.dim),
            "images": np.array(self._images, np.float32).reshape(-1, self._target.shape[1]),
            "weights": self._trainer.state_dict(),
            "rng": self._rng.bit_generator.state,
        }

    def _load_own_state(self, state: Mapping[str, Any]) -> None:
        if bool(state["trained"]) != (state["weights"] is not None):
            raise ValueError(f"{state['trained']} trainings, and the weights do not fit them")
        self._trainer.load_state_dict(state["weights"])
        self.trained = state["trained"]
        self._x, self._images = list(state["x"]), list(state["images"])
        self._rng.bit_generator.state = state["rng"]


def _checked_quantile(value: float) -> float:
    """`value`; OptionError unless it lies in (0, 1)."""
    quantile = positive("quantile", value)
    if quantile >= 1:
        raise OptionError(f"quantile must lie in (0, 1), not {value!r}")
    return quantile
