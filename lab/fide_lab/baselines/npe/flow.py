"""The posterior of sbi: a convolutional embedding of the image and a neural spline flow.

`Embedding` is sbi's `CNNEmbedding`, of images whose values are standardized by the first ones that
were seen.  The flow is its `posterior_nn("nsf")`, trained by its `NPE`.  Later rounds go on with
the weights of the round before, as sbi does.

sbi writes its losses to a folder for TensorBoard unless it is given a tracker of one's own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from fide_lab.baselines.penalty import quietly
from fide_plugins.runtime.machine import missing
from fide_plugins.types import Float32, Float64

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["Embedding", "Flow", "Trainer", "import_sbi", "seeded"]

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
            starts = range(0, len(theta), CHUNK)
            parts = [self._part(theta[start : start + CHUNK]) for start in starts]
        return torch.cat(parts).nan_to_num(-torch.inf, posinf=-torch.inf)

    def _part(self, points: Tensor) -> Tensor:
        part: Tensor = self._estimator.log_prob(points[:, None], condition=self._image)[:, 0]
        return part


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
        once = len(images) > 1 and not torch.is_grad_enabled() and _all_equal(images)
        standardized = ((images[:1] if once else images) - self.mean) / self.std
        features: Tensor = self.network(standardized)
        return features.expand(len(images), -1) if once else features


def _all_equal(images: Tensor) -> bool:
    return bool((images[1:] == images[:1]).all())


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
        theta, x = torch.from_numpy(X.astype(np.float32)), self.images(images)
        if self.estimator is None:
            self.estimator = self._build(theta, x)
        trainer = _silent_npe()(
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


def _silent_npe() -> Any:
    """Sbi's trainer, without what it prints when it has converged."""
    from sbi.inference import NPE

    return type("NPE", (NPE,), {"_report_convergence_at_end": lambda *of: None})


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
