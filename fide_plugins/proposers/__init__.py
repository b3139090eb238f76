"""Proposers: what an image says about where the next candidates should lie."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fide_plugins.encoders.base import PatchEncoder
from fide_plugins.options import Options
from fide_plugins.proposers.base import Proposals, Proposer
from fide_plugins.search.cma_es import are_many

if TYPE_CHECKING:
    from fide_plugins.proposers.forward import ForwardProposer
    from fide_plugins.proposers.linear import LinearProposer

__all__ = ["Proposals", "Proposer", "make_proposer"]

_MOST_REMEMBERED = 600  # candidates; a generation costs a regression on as many


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
    if options.proposer == "linear":
        return _linear(options, dim, popsize, encoder, learned=learned)
    if options.proposer == "forward":
        return _forward(options, dim, popsize, encoder)
    if options.proposer == "both":
        from fide_plugins.proposers.ensemble import EnsembleProposer

        inverse = _linear(options, dim, popsize, encoder, learned=learned)
        return EnsembleProposer(inverse, _forward(options, dim, popsize, encoder))
    if options.proposer == "diffusion":
        return _diffusion(options, dim, seed, encoder)
    return None


def _linear(
    options: Options, dim: int, popsize: int, encoder: PatchEncoder, *, learned: bool
) -> LinearProposer:
    from fide_plugins.proposers.linear import LinearProposer

    o = options.proposal
    enough = 3 * dim // 2 if are_many(dim, popsize) else 0  # for a regression to tell apart
    generations = o.buffer_generations or (4 if dim > popsize else 8)
    remembered = min(max(generations * popsize, enough), _MOST_REMEMBERED)
    wanted = learned if o.screening is None else o.screening
    return LinearProposer(
        dim,
        capacity=remembered,
        channel_subsets=o.channel_subsets or encoder.channel_subsets,
        rank_weight_scale=o.rank_weight_scale,
        ridge=o.ridge,
        sources=o.sources,
        step=(o.shortest_step, o.longest_step),
        noise=o.sample_noise,
        r2_threshold=o.r2_threshold,
        minimum=min(2 * popsize, remembered),
        select=o.select_tokens,
        screening=wanted and dim > popsize,
    )


def _forward(options: Options, dim: int, popsize: int, encoder: PatchEncoder) -> ForwardProposer:
    from fide_plugins.proposers.forward import ForwardProposer

    o = options.proposal
    return ForwardProposer(
        dim,
        capacity=min(4 * dim + 20, _MOST_REMEMBERED),
        channels=(o.channel_subsets or encoder.channel_subsets)[0],
        minimum=popsize,
        select=o.select_tokens,
    )


def _diffusion(options: Options, dim: int, seed: int, encoder: PatchEncoder) -> Proposer:
    from fide_plugins.denoiser.sampling import evenly
    from fide_plugins.proposers.background import BackgroundProposer
    from fide_plugins.proposers.diffusion import DiffusionProposer

    o = options.network
    network = DiffusionProposer(
        dim,
        seed=seed,
        device=encoder.device,
        epochs=o.epochs,
        learning_rate=o.learning_rate,
        batch_size=o.batch_size,
        schedule=o.schedule if o.steps is None else evenly(o.steps),
        precision=o.precision,
        parameter_tokens=o.parameter_tokens,
    )
    in_background = options.background_training
    return BackgroundProposer(network, encoder.device) if in_background else network
