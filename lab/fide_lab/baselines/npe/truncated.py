"""Draws from the prior, cut to where the posterior has its mass (Deistler et al. 2022).

The region is that of the posterior's highest density but for a quantile of its mass, by sbi's
`get_density_thresholder`; the draws are those of its `RestrictedPrior`.  While the region is large,
prior points are drawn and rejected, afterwards posterior samples are resampled with the weights
1 / density (SIR).

sbi 0.27 takes what says whether a point is accepted, 0 or 1, for the logarithm of a density in
resampling, so that rejected points are only e times less likely.  It is given the logarithm here.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor
from torch.distributions import Distribution

from fide_lab.baselines.npe.flow import Flow

__all__ = ["draw_truncated"]

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
