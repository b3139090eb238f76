"""Which parameters change the same places of the image: parameter groups by sensitivity samples.

Each parameter of the incumbent is moved, alone, to a random value: one render each. The overlap of
what they change says which parameters form a group (`search.scene.parameter_groups`). What belongs
together depends on the renderer more than on the candidate: one round serves for all incumbents.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fide_plugins.population.training_sample import TrainingSample
from fide_plugins.runtime.schema import array, check, whole
from fide_plugins.search.scene.axes import Axes
from fide_plugins.search.scene.parameter_groups import find_parts, overlaps
from fide_plugins.search.scene.removal import changed
from fide_plugins.types import Float64, Indices

__all__ = ["Sensitivity"]


class Sensitivity:
    """Overlaps (p, p) of what p parameters change, averaged over rounds.

    dim: d.  channels: leading channels of the tokens in which changes are seen; None: all.
    axes: those of one parameter, such as a choice, are moved together; None: each is a parameter.
    """

    def __init__(self, dim: int, channels: int | None, axes: Axes | None = None) -> None:
        self.dim, self.channels = dim, channels
        self._axes = axes or Axes(dim)
        p = len(self._axes.axes_of)
        self.rounds = 0
        self._overlap = np.zeros((p, p))  # sum over all samples
        self._pairs = np.zeros((p, p))  # how often each pair was seen together

    def draw(self, x: Float64, rng: np.random.Generator) -> Float64:
        """Copies (p, d) of x (d,), each with one parameter at a random value."""
        samples = np.tile(x, (len(self._axes.axes_of), 1))
        samples[self._axes.parameter_of, np.arange(self.dim)] = rng.random(self.dim)
        return samples

    def learn(self, incumbent: TrainingSample, samples: Sequence[TrainingSample]) -> None:
        """Learn from renders of what `draw` gave; others, and missing ones, do no harm."""
        parameter_of = self._axes.parameter_of
        moved = [np.unique(parameter_of[sample.x != incumbent.x]) for sample in samples]
        single = [(int(m[0]), s) for m, s in zip(moved, samples, strict=True) if len(m) == 1]
        self.rounds += 1
        if not single:
            return
        which = np.array([i for i, _ in single])
        changes = [changed(incumbent.tokens, s.tokens, self.channels) for _, s in single]
        self._overlap, self._pairs = self._overlap.copy(), self._pairs.copy()
        np.add.at(self._overlap, np.ix_(which, which), overlaps(np.array(changes)))
        np.add.at(self._pairs, np.ix_(which, which), 1.0)

    @property
    def groups(self) -> list[Indices]:
        """Axes of parameters that belong together, as far as is known."""
        parts = find_parts(self._overlap / np.maximum(self._pairs, 1.0))
        return [np.concatenate([self._axes.axes_of[i] for i in part]) for part in parts]

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes."""
        return {"rounds": self.rounds, "overlap": self._overlap, "pairs": self._pairs}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put back what `state_dict` gave; raises ValueError for what it cannot have given."""
        square = array("p", "p", low=0.0)
        form = {"rounds": whole(), "overlap": square, "pairs": square}
        check(state, form, {"p": len(self._axes.axes_of)}, "sensitivity")  # type: ignore[arg-type]
        self.rounds = state["rounds"]
        self._overlap, self._pairs = state["overlap"], state["pairs"]
