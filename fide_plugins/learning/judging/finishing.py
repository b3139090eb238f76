"""What follows training: the density is calibrated, and renders say what it is worth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch

from fide_plugins.learning.judging.calibration import fitted_scale, split_held_out
from fide_plugins.learning.judging.familiarity import Familiarity
from fide_plugins.learning.judging.report import Distance, Report, judge
from fide_plugins.learning.networks.network import Network, as_input
from fide_plugins.learning.renders.renderer import Pixels
from fide_plugins.learning.training.one_training import Training, is_held_out
from fide_plugins.types import Float64

__all__ = ["familiarity_of", "report_of"]

_MOST_FEATURES = 4000  # renders by which the features of all are described


def report_of(
    network: Network,
    training: Training,
    distance: Distance,
    names: Sequence[str],
    *,
    failed: int,
    emulated: float | None,
    on_progress: Callable[[str, int, int], None],
) -> Report:
    """Calibrate the network, which its training has left, and judge it on held-out renders.

    names: (d,), of the axes.  failed: renders that failed.  emulated: see `Report`.
    on_progress: called with stage, done and total of a `LearnProgress`, after each picture.
    """
    x, images, seed = training.x, training.images, training.seed
    aside = is_held_out(len(x))
    fit, judges = split_held_out(aside)
    network.scale = fitted_scale(
        network, x[fit], images[fit], seed, partial(on_progress, "calibrate")
    )
    judgment = judge(
        network, x[judges], images[judges], names, distance, seed, partial(on_progress, "judge")
    )
    return Report(
        renders=int((~aside).sum()),
        failed=failed,
        held_out=int(aside.sum()),
        seconds=training.spent,
        nll=judgment.nll,
        within=judgment.within,
        coverage=judgment.coverage,
        ranks=judgment.ranks,
        unseen=judgment.unseen,
        curve=tuple((a, b, c) for a, b, c in training.curve),
        augment=training.augment,
        scale=network.scale,
        fitted=int(fit.sum()),
        parameters=judgment.parameters,
        emulated=emulated,
    )


def familiarity_of(network: Network, images: Pixels) -> Familiarity:
    """Familiarity of the renders (n, H, W, 3) of a training, the held-out ones among them."""
    aside = is_held_out(len(images))
    learned = np.flatnonzero(~aside)[:_MOST_FEATURES]  # of all images a copy would be large
    return Familiarity.of(_features(network, images[learned]), _features(network, images[aside]))


def _features(network: Network, images: Pixels) -> Float64:
    """Features (n, F) of images (n, H, W, 3)."""
    parts = [network.vectors(as_input(images[i : i + 500])) for i in range(0, len(images), 500)]
    features: Float64 = torch.cat(parts).numpy().astype(np.float64)
    return features
