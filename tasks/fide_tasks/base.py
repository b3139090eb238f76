"""Base class of tasks: the box [0, 1]^dim, validation, batching, noise seeds, the target.

A task declares its `parameters` (one `Parameter` for each coordinate of x) and draws frames in
`_render`. The base class checks all arguments of callers.
"""

from __future__ import annotations

import operator
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from fide_plugins import Space

Image = NDArray[np.float32]  # (H, W, 3), or (n, H, W, 3) for a batch; values in [0, 1]
Vector = NDArray[np.float64]

_REFERENCE_FRAMES = 64  # frames of a noisy task whose mean is the reference
_RESERVED = 2**100  # first noise seed of `reference`


class Parameter(NamedTuple):
    """One coordinate of x, mapped linearly from [0, 1] to the physical range [low, high].

    group: what it belongs to, such as "cell 1" or "joint 3".
    name, unit: for people.
    low, high: range, in that unit.
    periodic: whether both ends give the same image, as of an angle all around.
    """

    group: str
    name: str
    unit: str
    low: float
    high: float
    periodic: bool = False


class Task(ABC):
    """A renderer with a target picture.

    Attributes
    ----------
    name: name in the registry.
    stochastic: whether two renders of one x differ by noise.
    incidental_options: names of options that do not change images, such as workers.
    parameters: one declared `Parameter` for each coordinate of x.
    alike: of groups "bead 1", "bead 2", ... the word, if they may change places in the image.
    size: (height, width) of the image in pixels.
    seed: chooses the target among those the task generates.
    """

    name: ClassVar[str]
    stochastic: ClassVar[bool] = False
    incidental_options: ClassVar[tuple[str, ...]] = ()
    alike: ClassVar[str | None] = None
    parameters: tuple[Parameter, ...]

    def __init__(
        self, size: int | tuple[int, int] = 224, seed: int = 0, *, target: ArrayLike | None = None
    ) -> None:
        """Set size and seed; `target`: a picture in place of the generated one, and its size."""
        self.seed = whole_number("seed", seed, minimum=0)
        self._picture = None if target is None else _checked_picture(target)
        self.size = _checked_size(size) if self._picture is None else self._picture.shape[:2]
        self._frames_rendered = 0  # a noisy task gives every unseeded frame its own noise

    @property
    def dim(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    @property
    def groups(self) -> list[list[int]] | None:
        """Which parameters are exchangeable: the indices of each block; None if none are.

        Exchanging the values of two blocks, in order, leaves the image as it is but for rounding
        and noise. Blocks are disjoint and equally long; parameters in no block belong to none. This
        is for tests and reports: no optimizer asks for it.
        """
        return None

    @property
    def shape(self) -> tuple[int, int, int]:
        """(H, W, 3), the shape of one image."""
        return (*self.size, 3)

    @property
    def target(self) -> Image:
        """The target picture, float32 (H, W, 3) in [0, 1]; made at the first access."""
        return np.array(self._target)

    @property
    def x_star(self) -> Vector | None:
        """Parameters that render the target, float64 (dim,); None if they are unknown."""
        return None if self._x_star is None else self._x_star.copy()

    def render(self, X: ArrayLike, seed: int | Sequence[int] | None = None) -> Image:
        """Render the candidates X, (n, dim), to images, float32 (n, H, W, 3) in [0, 1].

        Coordinates outside [0, 1] are clipped. Only noisy tasks use `seed`: the same x and seed
        give the same image; a number seeds a batch, a sequence of n numbers seeds each frame; None
        gives every frame new noise.

        Raises ValueError if X is not (n, dim), or has NaN or infinite entries.
        """
        x = self._checked(X)
        out: Image = np.empty((len(x), *self.shape), np.float32)
        self._render(self._physical(x), out, self._noise_seeds(len(x), seed))
        return out

    def reference(self, x: ArrayLike) -> Image:
        """Render the reference image of x, (dim,): float32 (H, W, 3) with little or no noise.

        The same x gives the same image. The noise is independent of all renders without a seed or
        with seeds below 2^100, up to chance: noise seeds have 32 bits.
        """
        return self._reference(self._one(x))

    def start(self) -> Vector | None:
        """Parameters, (dim,), read off the pixels of the target, near an answer; None if unknown.

        No render is spent. For pictures of the user's own, whose best parameters nobody knows: on a
        generated target it gives away what a search is to find, so no benchmark uses it.
        """
        return None

    def decode(self, x: ArrayLike) -> dict[str, dict[str, float]]:
        """Name the physical values of one candidate x, (dim,): {group: {"name [unit]": value}}.

        Pixel coordinates count from the upper left corner of the image, x to the right, y down.
        """
        values = self._one(x)
        decoded: dict[str, dict[str, float]] = {}
        for parameter, value in zip(self.parameters, values.tolist(), strict=True):
            group = decoded.setdefault(parameter.group, {})
            group[f"{parameter.name} [{parameter.unit}]"] = value
        return decoded

    @cached_property
    def space(self) -> Space:
        """The parameters as a `fide_plugins.Space`, with the same values as `decode`.

        "joint 1" is the group joint_1; "bead 1", "bead 2", ... are a list, if the beads may change
        places.  Needs the package fide_plugins.
        """
        from fide_tasks.named import space_of

        return space_of(self.parameters, self.alike)

    def check(self) -> None:
        """Render one frame to check that the task works on this machine; raises its error."""
        self.render(np.full((1, self.dim), 0.5))

    @abstractmethod
    def _render(self, values: Vector, out: Image, seeds: NDArray[np.uint32]) -> None:
        """Draw the physical values, (n, dim), into out, (n, H, W, 3); seeds: (n,), for noise."""

    def _reference(self, values: Vector) -> Image:
        """Draw the reference of physical values, (dim,); by default the mean of many frames."""
        frames = _REFERENCE_FRAMES if self.stochastic else 1
        image: Image = self._frames(values, frames).mean(axis=0, dtype=np.float64)
        return image.astype(np.float32)

    def _frames(self, values: Vector, n: int) -> Image:
        """Draw the physical values, (dim,), n times with reserved noise seeds."""
        out: Image = np.empty((n, *self.shape), np.float32)
        self._render(np.tile(values, (n, 1)), out, reserved_seeds(n))
        return out

    def _make_x_star(self) -> Vector | None:
        """Return the parameters of the generated target; None if none render it."""
        return None

    def _make_target(self) -> Image:
        """Return the generated target; by default the render of x_star."""
        if self._x_star is None:
            raise NotImplementedError(f"{type(self).__name__} generates neither x_star nor target")
        (image,) = self.render(self._x_star[None], seed=self.seed)
        return np.array(image)

    @cached_property
    def _target(self) -> Image:
        return self._make_target() if self._picture is None else self._picture

    @cached_property
    def _x_star(self) -> Vector | None:
        return self._make_x_star() if self._picture is None else None

    @cached_property
    def _range(self) -> tuple[Vector, Vector]:
        low = np.array([p.low for p in self.parameters])
        return low, np.array([p.high for p in self.parameters]) - low

    def _physical(self, x: Vector) -> Vector:
        low, width = self._range
        return low + x * width

    def _one(self, x: ArrayLike) -> Vector:
        """Physical values, (dim,), of one candidate."""
        x = np.asarray(x)
        values: Vector = self._physical(self._checked(x[None] if x.ndim == 1 else x, rows=1))[0]
        return values

    def _checked(self, X: ArrayLike, rows: int | None = None) -> Vector:
        x = np.asarray(X)
        if x.dtype.kind not in "biuf":
            raise ValueError(f"x must be real numbers, not of dtype {x.dtype}")
        if x.ndim != 2 or x.shape[1] != self.dim or (rows is not None and len(x) != rows):
            n = "n" if rows is None else rows
            hint = "; for one candidate pass x[None]" if x.shape == (self.dim,) else ""
            raise ValueError(f"x must have shape ({n}, {self.dim}), not {x.shape}{hint}")
        if not np.isfinite(x).all():
            row, column = np.argwhere(~np.isfinite(x))[0]
            raise ValueError(f"x must be finite, but x[{row}, {column}] is {x[row, column]}")
        return np.clip(x.astype(np.float64, copy=False), 0.0, 1.0)

    def _noise_seeds(self, n: int, seed: int | Sequence[int] | None) -> NDArray[np.uint32]:
        if not self.stochastic:
            return np.zeros(n, np.uint32)
        entropy: list[Any]
        if seed is None:
            first, self._frames_rendered = self._frames_rendered, self._frames_rendered + n
            entropy = [(self.seed, first + i) for i in range(n)]
        elif isinstance(seed, Sequence) or np.ndim(seed):
            entropy = [whole_number("seed", s, minimum=0) for s in seed]  # type: ignore[union-attr]
            if len(entropy) != n:
                raise ValueError(f"{len(entropy)} seeds for {n} candidates; pass one for each")
        else:
            state = np.random.SeedSequence(whole_number("seed", seed, minimum=0)).generate_state(n)
            return state.astype(np.uint32, copy=False)
        return _first_words(entropy)


def _first_words(entropy: list[Any]) -> NDArray[np.uint32]:
    states = [np.random.SeedSequence(one).generate_state(1)[0] for one in entropy]
    return np.array(states, np.uint32)


def reserved_seeds(n: int, stream: int = 0) -> NDArray[np.uint32]:
    """Return n noise seeds, always the same, that differ from those of all other streams."""
    return _first_words([(_RESERVED + stream, i) for i in range(n)])


def whole_number(name: str, value: Any, minimum: int) -> int:
    """Return `value` as int; ValueError if it is not a whole number >= `minimum`."""
    try:
        number = None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = None
    if number is None or number < minimum:
        raise ValueError(f"{name} must be a whole number >= {minimum}, not {value!r}")
    return number


def one_of(name: str, value: Any, choices: Sequence[str]) -> str:
    """Return `value`; ValueError listing the choices if it is none of them."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}, not {value!r}")
    return value


def _checked_size(size: int | tuple[int, int]) -> tuple[int, int]:
    sides = tuple(size) if isinstance(size, (tuple, list)) else (size, size)
    if len(sides) != 2:
        raise ValueError(f"size must be one number or (height, width), not {size!r}")
    return whole_number("size", sides[0], minimum=1), whole_number("size", sides[1], minimum=1)


def _checked_picture(picture: ArrayLike) -> Image:
    image = np.asarray(picture)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0 or image.dtype.kind != "f":
        raise ValueError(
            "a target picture must be float (H, W, 3) with values in [0, 1], "
            f"not {image.dtype} {image.shape}"
        )
    if not (np.isfinite(image).all() and image.min() >= 0 and image.max() <= 1):
        raise ValueError("a target picture must have finite values in [0, 1]")
    return np.array(image, np.float32, order="C")
