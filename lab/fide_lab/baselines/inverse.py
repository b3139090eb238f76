"""Inversion without evolution (Sec. 4.1): a diffusion model of the whole box, trained once.

Points are drawn uniformly from the box until a fraction of the budget is spent.  Then a diffusion
model learns which parameters made which image (`posterior_sampler`), and the rest of the budget
goes to its samples for the target.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from fide_lab.baselines.image_features import ImageBased
from fide_lab.baselines.posterior_sampler import PosteriorSampler
from fide_lab.baselines.stateful import Stateful
from fide_plugins.runtime.schema import GENERATOR, Schema, anything, array, flag
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.options import positive_fraction
from fide_plugins.validation.points import whole_number

__all__ = ["Inverse"]


class Inverse(ImageBased, Stateful):
    """Samples of the posterior; options of `ImageBased` and `Baseline`; `sigma0` is not used.

    popsize: points that are drawn at a time, 100.
    budget: evaluations that are planned.
    share: training fraction, the fraction of the budget that is spent on uniform points.
    epochs: passes over them; the last quarter has a smaller learning rate.
    batch_size, width, blocks: of the training and the network, see `denoiser`.

    The features of all uniform points are kept in memory until the training.

    Raises OptionError, and ImageError without a target (ValueErrors).
    """

    name: ClassVar[str] = "inverse"
    own_schema: ClassVar[dict[str, Schema]] = {
        "trained": flag,
        "x": array("n", "d", low=0.0, high=1.0),
        "features": array("n", "f"),
        "posterior": anything,  # checks its own
        "rng": GENERATOR,
    }

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        budget: int = 10_000,
        share: float = 0.8,
        epochs: int = 14,
        batch_size: int = 100,
        width: int = 32,
        blocks: int = 2,
        **options: Any,
    ) -> None:
        super().__init__(dim, target, **options)
        self.budget = whole_number("budget", budget, 1)
        self.share = positive_fraction("share", share)
        self.epochs = whole_number("epochs", epochs, 1)
        self._sizes = {"batch_size": batch_size, "width": width, "blocks": blocks}
        self._rng = np.random.default_rng(self.seed)
        self._posterior = PosteriorSampler(self.dim, seed=self.seed, **self._sizes)
        self._trained = False
        self._x: list[Float64] = []  # uniform points so far
        self._features: list[Float32] = []  # of their images

    @property
    def training_points(self) -> int:
        """Number of uniform points on which it trains."""
        return max(1, round(self.share * self.budget))

    def _sample(self) -> Float64:
        if self._trained:
            return self._posterior.sample(self.popsize, self.target_tokens)
        return self._rng.random((self.popsize, self.dim))  # ~ U(0, 1)

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        assert features is not None
        if self._trained:
            return
        self._x.extend(X)
        self._features.extend(features)
        if len(self._x) >= self.training_points:
            with self._timed("train"):
                tokens = self.tokens_of(np.array(self._features))
                self._posterior.fit(np.array(self._x), tokens, self.epochs)
            self._trained, self._x, self._features = True, [], []
            self._population.forget_pending()

    def _default_popsize(self) -> int:
        return 100

    def _own_settings(self) -> dict[str, Any]:
        own = {"budget": self.budget, "share": self.share, "epochs": self.epochs}
        return {**super()._own_settings(), **own, **self._sizes}

    def _own_state(self) -> dict[str, Any]:
        return {
            "trained": self._trained,
            "x": np.array(self._x).reshape(-1, self.dim),
            "features": np.array(self._features, np.float32).reshape(-1, self._sides()["f"]),
            "posterior": self._posterior.state_dict(),
            "rng": self._rng.bit_generator.state,
        }

    def _load_own_state(self, state: dict[str, Any]) -> None:
        self._trained = state["trained"]
        self._x, self._features = list(state["x"]), list(state["features"])
        self._posterior.load_state_dict(state["posterior"])
        self._rng.bit_generator.state = state["rng"]
