"""Arrays by name, what an optimizer is, what it returns, and what a model says of a picture."""

from __future__ import annotations

import os
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, Self, TypeAlias, runtime_checkable

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from fide_plugins.space import Space
    from fide_plugins.status import Status


Float64: TypeAlias = npt.NDArray[np.float64]
"""Parameters, losses and everything of the search."""
Float32: TypeAlias = npt.NDArray[np.float32]
"""Images and features."""
Mask: TypeAlias = npt.NDArray[np.bool_]
"""Which ones of several."""
Indices: TypeAlias = npt.NDArray[np.intp]
"""Which ones, by their numbers from 0."""

OPEN = 0.2  # standard deviation of a parameter that is not determined (a uniform one has 0.29)


class Posterior(NamedTuple):
    """What a learned model says of a picture.

    x: (n, d), draws; of sets of exchangeable blocks the first one is the middle of all.
    refined: (m, d), what descents through an emulator found, the best first; None without one.
    """

    x: Float64
    refined: Float64 | None = None


class Estimate(Protocol):
    """Of a solution, from what was known when the solution was read."""

    @property
    def std(self) -> Float64 | None:
        """(dim,), standard deviation of each parameter; None where it is not known."""

    @property
    def ambiguous(self) -> Mask | None:
        """(dim,), axes of integers and choices of which another value may be the true one."""

    @property
    def rough(self) -> bool:
        """Whether `std` is by samples of the search, and so depends on its path."""


@dataclass(frozen=True, eq=False)
class Estimated:
    """An estimate that was made."""

    std: Float64 | None
    ambiguous: Mask | None = None
    rough: bool = False


@dataclass(frozen=True, eq=False, repr=False)
class Solution:
    """A candidate that was evaluated.

    x: (dim,) float64, parameters in [0, 1].
    loss: its loss.
    evaluation: index, from 0, of the evaluation that found it.
    image: (H, W, 3) float32 in [0, 1], for a list of targets a list of them; None where only the
        loss was told.
    probability: share of the posterior, where a model knows one; None otherwise.
    space: names of the parameters; None: they have none.
    estimate: of `std`, computed when it is first asked for; None: not known.
    photometric: `comparison.Light` in which the image is compared with the target: gain, offset,
        curve and gamma of each channel; a list for a list of targets; None: as it is.
    """

    x: Float64
    loss: float
    evaluation: int
    image: Float32 | None = None
    probability: float | None = None
    space: Space | None = None
    estimate: Estimate | None = None
    photometric: Any = None

    def copy(self) -> Solution:
        """The same with arrays of its own: who reads a solution of an optimizer may write to it."""
        return replace(self, x=self.x.copy(), image=deepcopy(self.image))

    @property
    def params(self) -> dict[str, Any] | None:
        """Parameters by name, in their own units; None without a space."""
        return None if self.space is None else self.space.decode(self.x)

    @property
    def std(self) -> Float64 | None:
        """(dim,), standard deviation of each parameter, in units of the unit cube.

        It says how far the truth may be: by the noise of the images, by what the search has left,
        and by what the images do not show (at most 0.29, that of any value).  It is an estimate by
        a linear model, and local: of other basins it knows nothing.  That of `fit`'s `Result.best`
        is by renders around the answer (`uncertainty.at_answer`); others are by samples of the
        search.  NaN on the axes of integers and choices; None where too few images are known.
        Until it is read the solution keeps what the optimizer remembered (`memory_mb`).
        """
        return None if self.estimate is None else self.estimate.std

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Names of the parameters that the images do not determine; without a space "x[i]".

        Numbers whose `std` is at least 0.2; integers and choices of which another value explains
        the target as well.  Empty where nothing is known, as `std` is None.
        """
        if self.estimate is None or self.std is None:
            return ()
        open_axes = self.std >= OPEN  # False for NaN
        if self.estimate.ambiguous is not None:
            open_axes |= self.estimate.ambiguous
        if self.space is None:
            return tuple(f"x[{i}]" for i in np.flatnonzero(open_axes).tolist())
        return tuple(name for name, axes in self.space.axes.items() if open_axes[list(axes)].any())

    def __reduce__(self) -> tuple[Any, ...]:
        fields = (self.x, self.loss, self.evaluation, self.image, self.probability, self.space)
        known = Estimated(None)
        if self.estimate is not None:
            known = Estimated(self.std, self.estimate.ambiguous, self.estimate.rough)
        return Solution, (*fields, known, self.photometric)

    def __repr__(self) -> str:
        what = f"dim={len(self.x)}" if self.space is None else f"params={self.params}"
        return f"Solution(loss={self.loss:.6g}, evaluation={self.evaluation}, {what})"


@runtime_checkable
class Optimizer(Protocol):
    """FIDE and all its rivals: minimize over [0, 1]^dim by ask and tell."""

    dim: int
    popsize: int

    @property
    def name(self) -> str:
        """Name in `fide_lab.optimizers`."""

    @property
    def evaluations(self) -> int:
        """Points told so far."""

    @property
    def times(self) -> dict[str, float]:
        """Seconds spent so far in "encode" (losses and features), "train", "search"."""

    @property
    def best(self) -> Solution | None:
        """Best point told so far."""

    @property
    def status(self) -> Status | None:
        """What is known of the run so far; None where the optimizer does not say."""

    def ask(self, n: int | None = None) -> Float64:
        """Candidates (n, dim) in [0, 1]; None: what is left of the generation."""

    def ask_ready(self) -> Float64:
        """As `ask`, but what is best told before more is asked: one step, or a generation."""

    def tell(self, X: object, images: object = None, losses: object = None) -> object:
        """Report results: points (n, dim) with their images, losses (n,), or both."""

    def recommend(self) -> Float64:
        """Point (dim,) that the search believes in."""

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a checkpoint."""

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Optimizer that goes on from a checkpoint."""
