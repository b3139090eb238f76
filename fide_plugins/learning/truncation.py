"""The prior, cut to where a model's posterior of one picture is: parameters of a second round.

Truncated sequential neural posterior estimation (Deistler et al. 2022, arXiv:2210.04815).  The
region is where the density of the posterior is above a quantile of that of its samples.  Within it
points are drawn as the prior draws them, so a network that learns them and those of the first round
by plain maximum likelihood goes on to learn the posterior: there the mixture of both is the prior
times a constant.

The region is a small part of the cube, so points are drawn by sampling importance resampling:
samples of the posterior, chosen with weights 1 / density.  A finite choice is only nearly uniform:
it prefers the middle of the region a little.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any, Self

import numpy as np

from fide_plugins.errors import OptionError
from fide_plugins.learning.hypotheses import unlike_all
from fide_plugins.learning.model import Model
from fide_plugins.learning.renders.renderer import Pixels
from fide_plugins.learning.renders.store import SHARD, RenderStore
from fide_plugins.runtime.devices import digest
from fide_plugins.runtime.messages import warn_user
from fide_plugins.types import Float64, Indices
from fide_plugins.validation.images import as_target

__all__ = ["Truncated", "choose_evenly"]

_OUTSIDE = 0.02  # of the posterior's samples; with less the tails of a young model fill the cube
_SAMPLES = 5000  # that say where the region ends
_DRAWN = 16  # samples of which one is chosen


class Truncated:
    """The prior within the region of a model's posterior of a picture.

    store: renders of the model, of the whole cube.
    seed: of its points.
    """

    def __init__(self, model: Model, picture: object, store: RenderStore, seed: int) -> None:
        self.model, self.picture, self.store, self._seed = model, as_target(picture), store, seed
        samples = model.sample(self.picture, _SAMPLES, _seed(seed, 0))
        self.threshold = float(np.quantile(model.log_prob(self.picture, samples), _OUTSIDE))
        """Logarithm of the density at the end of the region, in nats."""

    @classmethod
    def read(cls, after: str | os.PathLike[str], picture: object, seed: int) -> Self:
        """Region of a model's file, with its renders beside it.

        Warns of a picture unlike all renders.  Raises OSError, CheckpointError, ImageError;
        OptionError without the renders, or where the model is one of a second round.
        """
        model, folder = Model.load(after), Path(f"{os.fspath(after)}.renders")
        if not (folder / "settings").exists():
            raise OptionError(f"the renders of the model {os.fspath(after)} are missing: {folder}")
        store = RenderStore.open(folder)
        if "picture" in store.settings:
            raise OptionError(
                f"{os.fspath(after)} has learned the region of one picture; after=MODEL needs a "
                "model of the whole space"
            )
        far = model.unfamiliarity(picture)
        if far > 1:
            warn_user(f"{unlike_all(model, far)}: a second round renders where that model guesses")
        return cls(model, picture, store, seed)

    @property
    def settings(self) -> dict[str, Any]:
        """What its points depend on, besides the seed: digests of network and picture."""
        pixels = hashlib.sha256(np.ascontiguousarray(self.picture).tobytes())
        return {"after": digest(self.model.network), "picture": pixels.hexdigest()[:16]}

    def parameters(self, shard: int) -> Float64:
        """Points (SHARD, d) of a shard; the same points for the same shard."""
        return self.points(SHARD, _seed(self._seed, 1 + shard))

    def points(self, n: int, seed: int) -> Float64:
        """Points (n, d) of the region, nearly uniform."""
        drawn = self.model.sample(self.picture, _DRAWN * n, seed)
        density = self.model.log_prob(self.picture, drawn)
        inside = density >= self.threshold
        rng = np.random.default_rng(seed)
        return drawn[inside][choose_evenly(density[inside], n, rng)]

    def renders(self) -> tuple[Float64, Pixels]:
        """Parameters (n, d) and images (n, H, W, 3) of the first round."""
        return self.store.read_all()


def choose_evenly(density: Float64, n: int, rng: np.random.Generator) -> Indices:
    """Which n of the points with these logarithms of a density (m,) are as if drawn uniformly.

    Without repetition, with weights 1 / density, by Gumbel's trick.
    """
    keys = rng.gumbel(size=len(density)) - density
    return np.argpartition(-keys, n - 1)[:n]


def _seed(seed: int, number: int) -> int:
    return int(np.random.default_rng((seed, 3, number)).integers(2**62))
