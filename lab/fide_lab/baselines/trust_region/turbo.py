"""TuRBO (Eriksson et al. 2019) with one trust region: a Gaussian process of the loss.

The steps and numbers are those of the authors' program, but for the process: BoTorch's
`SingleTaskGP` with a Matérn-5/2 kernel, its priors and its fit, where theirs makes 50 steps of Adam
within narrow limits; and draws of the process without the noise of evaluations, which theirs adds.
"""

from __future__ import annotations

from contextlib import suppress
from typing import ClassVar

import torch
from torch import Tensor

from fide_lab.baselines.trust_region.base import Surrogate, TrustRegion
from fide_plugins.types import Float32, Float64

__all__ = ["LossModel", "TuRBO"]


class TuRBO(TrustRegion):
    """Trust-region Bayesian optimization of the loss; extra `botorch`.

    popsize: points a round, 4.
    initial: points of a Latin hypercube at every start; None: 2 d.
    candidates: points that are drawn from each round; None: 100 d, but at most 5,000.
    steps: of L-BFGS, by which the process is fitted.
    smallest: side of the region, in (0, 0.8), below which a new search begins; 0.5**7.

    The other options are those of `Baseline`; `sigma0` is not used.

    Raises OptionError (a ValueError), and DependencyError (an ImportError) without BoTorch.
    """

    name: ClassVar[str] = "turbo"

    def _outputs(self, losses: Float64, features: Float32 | None) -> tuple[Float64, Float64]:
        return losses[:, None], losses

    def _fit(self, X: Tensor, outputs: Tensor) -> Surrogate:
        return LossModel(X, outputs, self.steps)


class LossModel(Surrogate):
    """BoTorch's process of losses (n, 1) at points (n, d)."""

    def __init__(self, X: Tensor, losses: Tensor, steps: int) -> None:
        from botorch.exceptions import ModelFittingError
        from botorch.fit import fit_gpytorch_mll
        from botorch.models import SingleTaskGP
        from botorch.models.utils.gpytorch_modules import get_covar_module_with_dim_scaled_prior
        from gpytorch.mlls import ExactMarginalLogLikelihood

        kernel = get_covar_module_with_dim_scaled_prior(X.shape[1], use_rbf_kernel=False)
        self.model = SingleTaskGP(X, -losses, covar_module=kernel)
        likelihood = ExactMarginalLogLikelihood(self.model.likelihood, self.model)
        with suppress(ModelFittingError):  # it then goes on with the priors' modes
            fit_gpytorch_mll(likelihood, optimizer_kwargs={"options": {"maxiter": steps}})
        self.model.eval()
        self.lengthscales = kernel.lengthscale.detach()[0]

    def choose(self, points: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """Of points (c, d), those (n, d) that are best in n draws."""
        from botorch.generation import MaxPosteriorSampling

        with torch.no_grad():
            chosen: Tensor = MaxPosteriorSampling(self.model, replacement=False)(points, n)
        return chosen
