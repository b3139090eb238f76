"""What a move is, and what all moves know.

A move leaves a local optimum, the *incumbent*, in three steps: it proposes *restart candidates*,
most of them copies of the incumbent with some parameters changed; these are rendered; a search
begins at the best of them. Some moves need to know more of the scene first, and name the stage
(a generation with a purpose of its own) that finds it out.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import ClassVar

import numpy as np
from torch import Tensor

from fide_plugins.population.candidate import TrainingSample
from fide_plugins.search.scene.axes import Axes
from fide_plugins.search.scene.exchangeability import Exchangeability
from fide_plugins.search.scene.optima import APART, Optima
from fide_plugins.search.scene.removal import Removal
from fide_plugins.search.scene.sensitivity import Sensitivity
from fide_plugins.search.scene.values import Values
from fide_plugins.types import Float64, Mask

__all__ = ["Known", "Move", "Stage", "Start"]

WIDE, NARROW = 1 / 2, 1 / 8  # of sigma0: in the parameters that were moved, in all others


class Stage(StrEnum):
    """What the candidates of a generation are for."""

    SEARCH = "search"
    EXCHANGE = "exchange"
    REMOVAL = "removal"
    SENSITIVITY = "sensitivity"
    RESTART = "restart"


@dataclass(frozen=True, slots=True)
class Start:
    """Where a search begins.

    mean, std: (d,), of its first distribution.
    population: its population size in units of the run's.
    patience: generations without progress that end it, in units of the run's.
    brisk_above: loss above which it has to be quick, see `termination`; None: it may be slow.
    widest: mean standard deviation that it may come to, in units of that of its beginning.
    to_the_end: whether it goes on where other searches have collapsed, see `termination`.
    held: (d,), axes that keep their coordinates in the mean during the search; None: none.
    """

    mean: Float64
    std: Float64
    population: int = 1
    patience: int = 1
    brisk_above: float | None = None
    widest: float = 1.0
    to_the_end: bool = False
    held: Mask | None = None


@dataclass(kw_only=True, slots=True)
class Known:
    """What is known of the scene and of its local optima.

    x0, sigma0: (d,), mean and standard deviation of the first search.
    target: (T, C), tokens of the target; channels: the leading ones in which images are compared.
    exchangeability, removal, sensitivity: what was found of the parameters by stages of their own.
    axes: which axes of the cube belong to one parameter, and which wrap around.
    place: points of the cube (n, d) as they are rendered: integers and choices in their cells.
    incumbent: local optimum that moves leave; None before the first, and after a search began
        without images.
    optima: distinct local optima.
    values: of integers and choices, and which of them were searched.
    blurs: whether searches that begin coarse are useful here (`comparison.scale_space`).

    What was found of the scene (exchangeability, removal, sensitivity, optima, values) is described
    in its file of `search.scene`.
    """

    x0: Float64
    sigma0: Float64
    target: Tensor
    channels: int | None
    exchangeability: Exchangeability
    removal: Removal
    sensitivity: Sensitivity
    axes: Axes
    place: Callable[[Float64], Float64] = np.copy
    incumbent: TrainingSample | None = None
    optima: Optima = field(default_factory=Optima)
    values: Values = field(default_factory=Values)
    blurs: bool = False

    @property
    def dim(self) -> int:
        """Number of parameters d."""
        return len(self.x0)

    @property
    def here(self) -> TrainingSample:
        """The incumbent, which must be there."""
        if self.incumbent is None:
            raise RuntimeError("no move leaves a local optimum before there is one")
        return self.incumbent

    def is_elsewhere(self, begun: Float64, ended: Float64) -> bool:
        """Whether a search that left the incumbent began elsewhere than it ended, (d,) each.

        So it is evidence of where it ended.  More than half of all parameters must have been
        changed, and be apart: what keeps most of them, right or wrong, comes back to them.
        """
        axes = self.axes
        moved = np.unique(axes.parameter_of[begun != self.here.x])
        if 2 * len(moved) <= len(axes.axes_of):
            return False
        apart = axes.difference(begun, self.exchangeability.aligned(ended, begun))
        return all(apart[axes.axes_of[i]].max() >= APART for i in moved)

    def copies(self, n: int) -> Float64:
        """Copies (n, d) of the incumbent's parameters."""
        return np.tile(self.here.x, (n, 1))

    def start_at(self, x: Float64, wide: float = WIDE, narrow: float = NARROW) -> Start:
        """Start at a restart candidate (d,): wide where it differs from the incumbent.

        wide, narrow: standard deviations in units of sigma0.
        """
        std = narrow * self.sigma0
        moved = self.axes.together(np.flatnonzero(x != self.here.x))
        std[moved] = wide * self.sigma0[moved]
        return Start(x, std)


class Move(ABC):
    """One way to leave a local optimum.

    name: by which it is chosen and saved.
    prior_gain: share by which it is expected to lower the loss, as long as it was not tried.
    from_incumbent: whether its restart candidates are copies of the incumbent with something
        changed.  Then its gain is measured from there, and it is chosen by its gain (`choice`);
        otherwise the policy says when it is due.
    has_goal: whether its search is over when it has no hope to become better than the incumbent.
    has_more: whether `draw` gives other candidates each time, which are as good as the first ones.
    """

    name: ClassVar[str]
    prior_gain: ClassVar[float] = 0.1
    from_incumbent: ClassVar[bool] = True
    has_goal: ClassVar[bool] = True
    has_more: ClassVar[bool] = True

    @abstractmethod
    def possible(self, known: Known) -> bool:
        """Whether the move applies to this scene, as far as is known."""

    def needs(self, known: Known) -> Stage | None:
        """Stage that must come before the restart candidates; None if nothing is missing."""
        return None

    @abstractmethod
    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Draw restart candidates, (n, d) in [0, 1]; fewer where the move has no more."""

    @abstractmethod
    def begin_at(self, known: Known, x: Float64) -> Start:
        """Return where the search begins, given the best restart candidate x (d,)."""

    def note_begun(self, known: Known, x: Float64) -> None:  # noqa: B027 - most moves need no note
        """Note in `known` that a search begins at x (d,); for moves that do not go there twice."""
