"""Truncated sequential neural posterior estimation, TSNPE (Deistler et al. 2022), by sbi.

Round 1 renders uniform points of the box, and a network learns p(x | image) from them.  Each later
round renders points of the box cut to where the network sees the target's posterior, and training
goes on with all points so far; as they are the prior's, but for the cut, nothing is corrected.
What is left of the budget goes to samples of the posterior.

The network is sbi's `CNNEmbedding` of an image of at most `size` pixels a side, standardized by the
first ones that were seen, and its `posterior_nn("nsf")`.  Exchangeable blocks are put in one order
(`canonical`): otherwise the posterior has as many modes as there are orders.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from fide_lab.baselines.base import Stateful, needed_images, needed_target, quietly
from fide_plugins.errors import OptionError
from fide_plugins.runtime.machine import missing
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
from fide_plugins.types import Float32, Float64, Indices
from fide_plugins.validation.options import positive, positive_fraction
from fide_plugins.validation.points import whole_number

if TYPE_CHECKING:
    from collections.abc import Iterator


def canonical(X: Float64, blocks: Indices | None) -> Float64:
    """Points (n, d) with their exchangeable blocks in ascending order of their values.

    blocks: (m, L), the L parameters of each block; None: there are none.  Blocks are ordered by
        their first parameter; where it is equal, by the second, and so on.
    """
    if blocks is None:
        return X
    things = X[:, blocks]  # (n, m, L)
    keys = np.moveaxis(things, 2, 0)[::-1]  # the last key is the most important one
    order = np.lexsort(keys, axis=1)  # (n, m)
    ordered = X.copy()
    ordered[:, blocks] = np.take_along_axis(things, order[:, :, None], axis=1)
    return ordered


LEAST_STD = 1e-3  # of the values of all images: constant ones are not blown up
FEATURES = 64  # of an image, and units of the layers that make them
CHANNELS = (6, 12)  # sbi's default
LEARNING_RATE = 1e-3  # of Adam; sbi's default is 5e-4, with passes without end
CHUNK = 1000  # points whose densities are computed at once


class Flow:
    """Density of points given one image; what sbi's truncated proposals call a distribution.

    estimator: of sbi.  image: (1, 3, h, w).  order: puts points (n, d) in their canonical order.
    """

    def __init__(self, estimator: Any, image: Tensor, order: Callable[[Tensor], Tensor]) -> None:
        self._estimator, self._image, self._order = estimator, image, order

    def sample(self, shape: tuple[int, ...]) -> Tensor:
        """Draw points (n, d), float32, in the unit cube and in their canonical order.

        Of twice as many, those in the cube.  Where these are too few, the others are clipped, so
        that a flow that leaks takes no longer.
        """
        n = int(np.prod(shape))
        with torch.no_grad():
            drawn = self._estimator.sample((2 * n,), condition=self._image)[:, 0]
        drawn = drawn.nan_to_num(0.5)
        outside = ((drawn < 0) | (drawn > 1)).any(dim=1)
        first = torch.argsort(outside.to(torch.int8), stable=True)[:n]
        points: Tensor = self._order(drawn[first].clamp(0.0, 1.0))
        return points

    def log_prob(self, theta: Tensor) -> Tensor:
        """Logarithm of the density (n,) at points (n, d); -inf where it is no number.

        It is not corrected for what leaks out of the cube, which is the same for all points.
        """
        with torch.no_grad():
            parts = [
                self._estimator.log_prob(points[:, None], condition=self._image)[:, 0]
                for points in torch.split(theta, CHUNK)
            ]
        return torch.cat(parts).nan_to_num(-torch.inf, posinf=-torch.inf)


class Embedding(nn.Module):
    """sbi's `CNNEmbedding` of images (n, 3, h, w), by mean and std of the first ones.

    Where all images of a batch are the same, as in sampling, one is embedded.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, shape: tuple[int, int], mean: float, std: float) -> None:
        from sbi.neural_nets.embedding_nets import CNNEmbedding

        super().__init__()
        self.register_buffer("mean", torch.tensor(mean))
        self.register_buffer("std", torch.tensor(max(std, LEAST_STD)))
        self.network = CNNEmbedding(
            shape,
            in_channels=3,
            out_channels_per_layer=list(CHANNELS),
            num_linear_units=FEATURES,
            output_dim=FEATURES,
        )

    def forward(self, images: Tensor) -> Tensor:
        """Features (n, FEATURES)."""
        many = len(images) > 1 and not torch.is_grad_enabled()
        once = many and bool((images[1:] == images[:1]).all())
        standardized = ((images[:1] if once else images) - self.mean) / self.std
        features: Tensor = self.network(standardized)
        return features.expand(len(images), -1) if once else features


class Trainer:
    """A flow, and its training.

    dim: d.  shape: (h, w) of the images.  width, transforms: hidden units and layers of the flow.
    epochs: passes over the data, at most.  batch_size: points of a step.
    """

    def __init__(
        self,
        dim: int,
        shape: tuple[int, int],
        *,
        width: int,
        transforms: int,
        epochs: int,
        batch_size: int,
    ) -> None:
        from sbi.utils import BoxUniform

        self._dim, self._shape = dim, shape
        self._width, self._transforms = width, transforms
        self._epochs, self._batch_size = epochs, batch_size
        self.prior = BoxUniform(torch.zeros(dim), torch.ones(dim))
        self.estimator: Any = None
        """Trained so far; None before."""

    def fit(self, X: Float64, images: Float32) -> None:
        """Train on points (n, d), all from the prior or a truncated one, and images (n, f)."""
        from sbi import inference

        theta, x = torch.from_numpy(X.astype(np.float32)), self.images(images)
        if self.estimator is None:
            self.estimator = self._build(theta, x)
        silent = {"_report_convergence_at_end": lambda *of: None}  # which prints
        trainer = type("NPE", (inference.NPE,), silent)(
            self.prior,
            density_estimator=lambda theta, x: self.estimator,
            show_progress_bars=False,
            tracker=_NoTracker(),
        )
        trainer.append_simulations(theta, x)
        trained = trainer.train(
            max_num_epochs=self._epochs - 1,  # sbi makes one more
            training_batch_size=self._batch_size,
            learning_rate=LEARNING_RATE,
            force_first_round_loss=True,  # a truncated prior needs no correction
        )
        self.estimator = trained.eval()

    def images(self, features: Float32) -> Tensor:
        """Images (n, 3, h, w) of rows (n, f)."""
        return torch.from_numpy(features).reshape(len(features), 3, *self._shape)

    def state_dict(self) -> dict[str, Tensor] | None:
        """Weights; None before the first training."""
        return None if self.estimator is None else dict(self.estimator.state_dict())

    def load_state_dict(self, weights: Mapping[str, Any] | None) -> None:
        """Put back what `state_dict` gave, be it arrays; RuntimeError if it is of another one."""
        if weights is None:
            self.estimator = None
            return
        with seeded(0):  # the values are replaced: any will do
            estimator = self._build(torch.rand(8, self._dim), torch.rand(8, 3, *self._shape))
        loaded = {key: torch.as_tensor(value) for key, value in weights.items()}
        estimator.load_state_dict(loaded)
        self.estimator = estimator.eval()

    def _build(self, theta: Tensor, x: Tensor) -> Any:
        from sbi.neural_nets import posterior_nn

        build = posterior_nn(
            "nsf",
            z_score_x="none",
            hidden_features=self._width,
            num_transforms=self._transforms,
            embedding_net=Embedding(self._shape, float(x.mean()), float(x.std())),
        )
        return build(theta, x)


class _NoTracker:
    """Writes nothing."""

    log_dir = None

    def log_metric(self, *args: Any, **options: Any) -> None:
        """Nothing."""

    log_metrics = log_params = add_figure = flush = log_metric


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """PyTorch's global generator, from which sbi draws, is lent to it, without its warnings."""
    with quietly(), torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)  # that of the CPU alone, which is restored
        yield


def import_sbi(name: str) -> None:
    """Raise DependencyError (an ImportError) unless sbi is there."""
    try:
        with seeded(0):
            import sbi.inference  # noqa: F401
    except ImportError as error:
        raise missing("sbi", f"{name} needs sbi") from error


LEAST_ACCEPTED = 0.05  # share of prior points in the region below which samples are resampled
TRIED = 1000  # prior points that tell


def draw_truncated(
    n: int,
    prior: Distribution,
    flow: Flow,
    order: Callable[[Tensor], Tensor],
    quantile: float,
    support: int,
) -> Tensor:
    """Draw n points (n, d) from the truncated prior, in their canonical order.

    The region is that of the posterior's highest density but for a quantile of its mass.  While it
    is large, prior points are drawn and rejected, afterwards posterior samples are resampled with
    the weights 1 / density (SIR).  sbi 0.27 takes what says whether a point is accepted, 0 or 1,
    for the logarithm of a density in resampling; it is given the logarithm here.

    order: puts points in it.  quantile: mass of the posterior that is left out.
    support: samples by which the threshold of its density is found.
    """
    from sbi.utils import RestrictedPrior, get_density_thresholder

    inside = get_density_thresholder(flow, quantile, support)

    def accept(theta: Tensor) -> Tensor:
        accepted: Tensor = inside(order(theta))
        return accepted

    if accept(prior.sample((TRIED,))).float().mean() >= LEAST_ACCEPTED:
        restricted = RestrictedPrior(prior, accept)
        return order(restricted.sample((n,), print_rejected_frac=False))
    if accept(flow.sample((TRIED,))).float().mean() < 0.5:  # a flow of hardly any density
        return flow.sample((n,))
    restricted = RestrictedPrior(prior, lambda theta: accept(theta).log(), flow, "sir")
    return order(restricted.sample((n,)))


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
    own_options = (
        "budget", "share", "rounds", "quantile", "size", "support", "width", "transforms",
        "epochs", "batch_size",
    )  # fmt: skip
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
        self.quantile = positive("quantile", quantile)
        if self.quantile >= 1:
            raise OptionError(f"quantile must lie in (0, 1), not {quantile!r}")
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
        h, w = (min(self.size, max(LEAST_SIDE, side)) for side in target.shape[:2])
        self._shape = h, w
        self._target = self._encode(target[None])
        self._rng = np.random.default_rng(self.seed)
        self._trainer = Trainer(
            self.dim, self._shape, width=self.width, transforms=self.transforms,
            epochs=self.epochs, batch_size=self.batch_size,
        )  # fmt: skip
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

    def _ordered(self, points: Tensor) -> Tensor:
        """Points (n, d) in their canonical order."""
        ordered: Float64 = canonical(points.numpy(), self._blocks)
        return points.new_tensor(ordered)

    def _new_seed(self) -> int:
        return int(self._rng.integers(2**31))

    def _default_popsize(self) -> int:
        return max(LEAST_POINTS, round(self.share * self.budget / self.rounds))

    def _sides(self) -> Sides:
        return super()._sides() | {"f": self._target.shape[1]}

    def _own_settings(self) -> dict[str, Any]:
        groups = None if self._blocks is None else self._blocks.tolist()
        return {**super()._own_settings(), "groups": groups}

    def _own_state(self) -> dict[str, Any]:
        return {
            "trained": self.trained,
            "x": np.array(self._x).reshape(-1, self.dim),
            "images": np.array(self._images, np.float32).reshape(-1, self._target.shape[1]),
            "weights": self._trainer.state_dict(),
            **super()._own_state(),
        }

    def _load_own_state(self, state: dict[str, Any]) -> None:
        if bool(state["trained"]) != (state["weights"] is not None):
            raise ValueError(f"{state['trained']} trainings, and the weights do not fit them")
        self._trainer.load_state_dict(state["weights"])
        self.trained = state["trained"]
        self._x, self._images = list(state["x"]), list(state["images"])
        super()._load_own_state(state)
