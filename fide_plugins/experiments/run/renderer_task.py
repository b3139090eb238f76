"""A user's renderer as a task: what is to be found are random parameters of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from fide_plugins.errors import OptionError
from fide_plugins.renderers import FunctionRenderer
from fide_plugins.renderers.fingerprint import fingerprint_of
from fide_plugins.renderers.function import is_reference
from fide_plugins.space import Space
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.images import as_target

__all__ = ["RendererTask", "is_reference", "make"]

_OPTIONS = ("space",)


class RendererTask:
    """Task whose target is the image of random parameters.

    name: of the task.
    renderer: function of a dictionary of parameters that returns an image (H, W, C) or (H, W); of
        x, (dim,) in [0, 1], where `space` is a number.
    space: the parameters; or their number.
    seed: chooses the parameters, which are uniform in the unit cube.

    search_space: `space`, for optimizers that handle integers and choices as such.
    x_star: (dim,), the parameters of the target; integers and choices in the middle of their cells.
    """

    def __init__(
        self, name: str, renderer: Callable[[Any], Any], space: Space | int, seed: int = 0
    ) -> None:
        self.name, self.seed, self._render = name, seed, renderer
        self.search_space = space if isinstance(space, Space) else None
        self.dim = space.dim if isinstance(space, Space) else space
        x = np.random.default_rng(seed).random(self.dim)
        self.x_star: Float64 = x if self.search_space is None else self.search_space.snap(x)
        self._target: Float32 | None = None

    @property
    def fingerprint(self) -> str | None:
        """That of the renderer."""
        return fingerprint_of(self._render)

    @property
    def target(self) -> Float32:
        """Image (H, W, 3) of `x_star`, rendered once; its size is the renderer's."""
        if self._target is None:
            self._target = as_target(self._render(self.decode(self.x_star)))
        return self._target

    def render(self, X: Float64, seed: Any = None) -> list[Any]:
        """Images of candidates (n, dim); the seed is for other tasks."""
        return [self._render(self.decode(x)) for x in X]

    def decode(self, x: Float64) -> Any:
        """What the renderer is given for a point (dim,)."""
        return x.copy() if self.search_space is None else self.search_space.decode(x)


def make(reference: str, seed: int, options: Mapping[str, Any]) -> RendererTask:
    """Task of the function ``FILE.py:NAME`` or ``module:NAME``.

    options: `space` is the path of a TOML file; without it the space is beside the function.

    Raises OptionError and SpaceError (ValueErrors), OSError if the file cannot be read.
    """
    for option in options:
        if option not in _OPTIONS:
            raise OptionError(f"{reference} has no option {option!r}; it has space")
    renderer = FunctionRenderer(reference)
    given = Space.read(options["space"]) if "space" in options else None
    return RendererTask(reference, renderer, renderer.space_or(given), seed)
