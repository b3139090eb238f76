"""Composite Bayesian optimization: Gaussian processes of the image, and not of its loss.

The loss is a known function of what is rendered, the squared distance from the target, so the
processes are of the image and the distance is computed of their draws (Astudillo and Frazier 2019;
for images Maddox et al. 2021).  Here they are of the principal components of the image's features,
in the trust region of `turbo`.

All components have one kernel, so that one Cholesky decomposition serves them all.  With K (n, n)
the correlation of the points and one noise for all, the variance of component y (n,) is its most
likely one, y^T K^-1 y / n, and the lengthscales and the noise minimize

    m log det K + n sum_j log (y_j^T K^-1 y_j / n) - 2 log prior(lengthscales).

Kernel, prior and the minimizer are BoTorch's and GPyTorch's.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from fide_lab.baselines.image_features import ImageBased
from fide_lab.baselines.trust_region.base import Surrogate, TrustRegion
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.points import whole_number

__all__ = ["CompositeBO", "ImageModel", "principal_components"]

NOISE = (1e-8, 1e-1)  # least and largest variance of the noise, of the process's
FIRST_NOISE = 1e-4
JITTER = 1e-8
_NOTHING = 1e-30  # variance of components where all images so far are equal


class CompositeBO(ImageBased, TrustRegion):
    """Trust-region Bayesian optimization of the image; extra `botorch`.

    popsize, initial, candidates, steps: as of `TuRBO`.
    smallest: side of the region, in (0, 0.8), below which a new search begins.  That of `TuRBO`,
        0.5**7, ends searches in the right basin before they have found it.
    components: principal components that are modelled; fewer while there are fewer images.
    channels: of the tokens of the encoder; by default the mean colors of 14 x 14 patches.

    The search minimizes the distance of the features.  The loss decides only which point is `best`.
    The other options are those of `ImageBased` and `Baseline`; `sigma0` is not used.

    Raises OptionError, ImageError without a target (ValueErrors), and DependencyError (an
    ImportError) without BoTorch.
    """

    name: ClassVar[str] = "composite-bo"

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        components: int = 24,
        channels: int | None = 3,
        smallest: float = 0.5**12,
        **options: Any,
    ) -> None:
        self.components = whole_number("components", components, 1)
        super().__init__(dim, target, channels=channels, smallest=smallest, **options)

    def _outputs(self, losses: Float64, features: Float32 | None) -> tuple[Float64, Float64]:
        assert features is not None
        wrong = features.astype(np.float64) - self.target_features  # (n, f)
        return wrong, np.square(wrong).mean(axis=1)

    def _fit(self, X: Tensor, outputs: Tensor) -> Surrogate:
        mean, scores = principal_components(outputs, self.components)
        return ImageModel(X, scores, mean, self.steps)

    def _own_settings(self) -> dict[str, Any]:
        return {**super()._own_settings(), "components": self.components}


def principal_components(wrong: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """Mean (m,) and scores (n, m) of differences (n, f), in the basis of their components.

    The squared norm of a difference is that of mean + scores, but for what is left out.
    """
    mean = wrong.mean(dim=0)
    _, singular, basis = torch.linalg.svd(wrong - mean, full_matrices=False)
    m = int((singular[:most] > 1e-9 * singular[0]).sum().clamp(min=1))
    basis = basis[:m]  # (m, f)
    return basis @ mean, (wrong - mean) @ basis.T


class ImageModel(Surrogate):
    """Processes of components Y (n, m) at points X (n, d); the aim is Y = -mean (m,)."""

    def __init__(self, X: Tensor, Y: Tensor, mean: Tensor, steps: int) -> None:
        from botorch.models.utils.gpytorch_modules import get_covar_module_with_dim_scaled_prior

        self._X, self._mean = X, mean
        self._kernel = get_covar_module_with_dim_scaled_prior(X.shape[1], use_rbf_kernel=False)
        self._kernel = self._kernel.to(X)
        self._log_noise = torch.nn.Parameter(X.new_tensor(FIRST_NOISE).log())
        self._learn(Y, steps)
        with torch.no_grad():
            self._root = self._decomposed()
            self._weights = torch.cholesky_solve(Y, self._root)  # K^-1 Y, (n, m)
            self._scales = ((Y * self._weights).sum(dim=0) / len(X)).sqrt()  # (m,)
        self.lengthscales = self._kernel.lengthscale.detach()[0]

    def posterior(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Mean (c, m) at points (c, d), and correlation (c, c) of what is unknown there."""
        across = self._kernel(points, self._X).to_dense()  # (c, n)
        half = torch.linalg.solve_triangular(self._root, across.T, upper=False)  # (n, c)
        return across @ self._weights, self._kernel(points).to_dense() - half.T @ half

    def choose(self, points: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """Of points (c, d), those (n, d) that are nearest to the target in n draws."""
        with torch.no_grad():
            mean, correlation = self.posterior(points)
            root = cholesky(correlation)
            free = torch.ones(len(points), dtype=torch.bool)
            chosen: list[int] = []
            for _ in range(n):
                normal = torch.randn(mean.shape, generator=generator, dtype=mean.dtype)
                drawn = self._mean + mean + (root @ normal) * self._scales  # (c, m)
                distance = drawn.square().sum(dim=1).where(free, torch.inf)
                chosen.append(int(distance.argmin()))
                free[chosen[-1]] = False
        return points[chosen]

    def _learn(self, Y: Tensor, steps: int) -> None:
        """Fit the lengthscales and the noise."""
        from botorch.optim.core import scipy_minimize

        lengthscale = self._kernel.raw_lengthscale  # is the lengthscale itself: no transform
        parameters = {"lengthscale": lengthscale, "noise": self._log_noise}
        limits = {"lengthscale": (2.5e-2, None), "noise": tuple(np.log(NOISE).tolist())}

        def closure() -> tuple[Tensor, list[Tensor]]:
            loss = self._loss(Y)
            return loss, list(torch.autograd.grad(loss, list(parameters.values())))

        scipy_minimize(closure, parameters, bounds=limits, options={"maxiter": steps})

    def _loss(self, Y: Tensor) -> Tensor:
        root = self._decomposed()
        white = torch.linalg.solve_triangular(root, Y, upper=False)  # (n, m)
        n, m = Y.shape
        fit = n * (white.square().sum(dim=0) / n).clamp_min(_NOTHING).log().sum()
        volume = 2 * m * root.diagonal().log().sum()
        prior = self._kernel.lengthscale_prior.log_prob(self._kernel.lengthscale).sum()
        loss: Tensor = (fit + volume - 2 * prior) / (n * m)
        return loss

    def _decomposed(self) -> Tensor:
        """Cholesky factor (n, n) of the correlation with its noise."""
        noise = self._log_noise.exp() * torch.eye(len(self._X), dtype=self._X.dtype)
        return cholesky(self._kernel(self._X).to_dense() + noise)


def cholesky(matrix: Tensor) -> Tensor:
    """Factor of a symmetric matrix, with more and more jitter if it is not quite positive."""
    eye = torch.eye(len(matrix), dtype=matrix.dtype)
    for power in range(8):
        root, failed = torch.linalg.cholesky_ex(matrix + JITTER * 10**power * eye)
        if not failed:
            break
    factor: Tensor = root
    return factor
