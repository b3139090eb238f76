"""Proposers: what an image says about where the next candidates should lie."""

from __future__ import annotations

from fide_plugins.encoders.base import PatchEncoder
from fide_plugins.options import Options
from fide_plugins.proposers.base import Proposer
from fide_plugins.proposers.feature_buffer import MOST
from fide_plugins.proposers.forward import GaussNewtonSteps
from fide_plugins.proposers.linear import LinearProposer
from fide_plugins.search.cma_es import are_many

__all__ = ["Proposer", "make_proposer", "make_step_model"]

_MOST_FOR_JACOBIAN = 100  # parameters; every step costs eigenvectors of as many


def make_proposer(
    options: Options,
    dim: int,
    popsize: int,
    seed: int,
    encoder: PatchEncoder,
    *,
    learned: bool = False,
) -> Proposer | None:
    """Proposer that the options name; None for "none".

    learned: whether the search begins at hypotheses of a learned model.
    """
    if options.proposer in ("linear", "both"):
        enough = 3 * dim // 2 if are_many(dim, popsize) else 0  # for a regression to tell apart
        generations = options.buffer_generations or (4 if dim > popsize else 8)
        remembered = min(max(generations * popsize, enough), MOST)
        wanted = learned if options.screening is None else options.screening
        return LinearProposer(
            dim,
            capacity=remembered,
            channel_subsets=options.channel_subsets or encoder.channel_subsets,
            minimum=min(2 * popsize, remembered),
            screening=wanted and dim > popsize,
        )
    if options.proposer == "none":
        return None
    from fide_plugins.proposers.diffusion import DiffusionProposer

    return DiffusionProposer(
        dim,
        seed=seed,
        device=encoder.device,
        epochs=options.epochs,
        learning_rate=options.learning_rate,
        batch_size=options.batch_size,
        schedule=options.schedule,
    )


def make_step_model(
    options: Options, dim: int, popsize: int, encoder: PatchEncoder, *, learned: bool = False
) -> GaussNewtonSteps | None:
    """Gauss-Newton steps between the generations; None where the options name none.

    Nor are there any where the search begins at hypotheses of a learned model, which are near the
    answer in what the model knows and anywhere in the rest; but of a photograph it completes them.
    """
    too_many = are_many(dim, popsize) or dim > _MOST_FOR_JACOBIAN
    if options.proposer != "both" or too_many or (learned and not options.photo):
        return None
    channels = (options.channel_subsets or encoder.channel_subsets)[0]
    return GaussNewtonSteps(dim, channels=channels, minimum=popsize)
