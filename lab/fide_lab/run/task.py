"""What is fitted: the protocol of a task, what one says of itself, a user's renderer as one."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from fide_plugins.errors import ImageError, OptionError
from fide_plugins.renderers import CommandRenderer, FunctionRenderer
from fide_plugins.renderers.command import TIMEOUT
from fide_plugins.runtime.registry import (
    fingerprint_of,
    is_reference,
    kind_of,
    own_name,
    version_of,
)
from fide_plugins.space import Space
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.images import as_batch, as_target


class Task(Protocol):
    """What is fitted: `fide_tasks` has some, and anything with these three will do.

    What it may have besides is listed in `TaskInfo`.
    """

    @property
    def dim(self) -> int:
        """Number of parameters."""

    @property
    def target(self) -> Any:
        """Picture to be found, (H, W, 3)."""

    def render(self, X: Float64, seed: Any = None) -> Any:
        """Images (n, H, W, 3) of candidates (n, dim); seeds [n] for those that are noisy."""


@dataclass(frozen=True)
class TaskInfo:
    """Optional attributes of a task, with a default for each that it does not have.

    name: by default that of its class.  seed: of the picture that it generates.
    reference: function of a point (dim,) that gives an image (H, W, 3) without noise, which judges.
    incidental_options: names of options that leave every image as it is, such as threads.
    renderer: name of what renders here, if images depend on it.
    search_space: named parameters, for an optimizer that handles integers and choices as such.
    piece: most candidates to render before their results are told; None: the loop's own number.
    error: function of a point (dim,), how wrong it is, see `run.foreign`; light: "none", "exposure"
        or "shading", what of the light differs in the target.
    """

    name: str
    seed: int | None = None
    reference: Callable[[Float64], Any] | None = None
    incidental_options: tuple[str, ...] = ()
    renderer: str | None = None
    search_space: Space | None = None
    piece: int | None = None
    error: Callable[[Float64], float] | None = None
    light: str = "none"

    @classmethod
    def of(cls, task: object) -> TaskInfo:
        """What this task says of itself now."""
        optional = [field.name for field in fields(cls) if field.name != "name"]
        said = {name: getattr(task, name) for name in optional if hasattr(task, name)}
        return cls(own_name(task), **said)


class RendererTask:
    """Task whose target is the image of random parameters, or a picture.

    renderer: function of a dictionary of parameters, or of x (dim,) in [0, 1] where `space` is a
        number, that returns an image (H, W, C) or (H, W).
    seed: chooses the parameters, which are uniform in the unit cube.
    picture: target instead of that of random parameters.

    x_star: (dim,), the parameters of the target, integers and choices in the middle of their cells;
        None for a picture.
    """

    piece = 1  # renders are independent, and may be slow or fail: none waits for others

    def __init__(
        self,
        name: str,
        renderer: Callable[[Any], Any],
        space: Space | int,
        seed: int = 0,
        picture: object = None,
    ) -> None:
        self.name, self.seed, self._render = name, seed, renderer
        self.search_space = space if isinstance(space, Space) else None
        self.dim = space.dim if isinstance(space, Space) else space
        # A stream of its own: many optimizers begin with `default_rng(seed).random`.
        x = np.random.default_rng((seed, self.dim)).random(self.dim)
        x = x if self.search_space is None else self.search_space.snap(x)
        self.x_star: Float64 | None = x if picture is None else None
        self._picture: Float32 | None = None if picture is None else as_target(picture)

    @property
    def fingerprint(self) -> str | None:
        """That of the renderer."""
        return fingerprint_of(self._render)

    @property
    def version(self) -> str | None:
        """That of the renderer."""
        return version_of(self._render)

    @cached_property
    def target(self) -> Float32:
        """Picture (H, W, 3); or the image of `x_star`, in the renderer's size.

        Raises ImageError (a ValueError) for a picture of another size than the renderer's images.
        """
        if self._picture is None:
            assert self.x_star is not None, "without a picture there are parameters"
            return as_target(self._render(self.decode(self.x_star)))
        self._check_size(self._picture)
        return self._picture

    def _check_size(self, picture: Float32) -> None:
        try:
            image = self._render(self.decode(np.full(self.dim, 0.5)))
            h, w = as_batch([image], on_clip=lambda message: None).shape[1:3]
        except Exception:  # the run says so if others fail, too
            return
        height, width = picture.shape[:2]
        if (h, w) != (height, width):
            raise ImageError(
                f"the picture has {width} x {height} pixels, and {self.name} renders {w} x {h}: "
                "give a picture of that size, or render that of the picture"
            )

    def render(self, X: Float64, seed: Any = None) -> list[Any]:
        """Images of candidates (n, dim); the seed is for other tasks."""
        return [self._render(self.decode(x)) for x in X]

    def decode(self, x: Float64) -> Any:
        """What the renderer is given for a point (dim,)."""
        return x.copy() if self.search_space is None else self.search_space.decode(x)


def source_of_target(task: object) -> str | None:
    """From which file and parameters a function renders the target; None where nobody knows."""
    if not isinstance(task, RendererTask) or task.x_star is None:
        return None
    file, space = task.fingerprint, task.search_space
    if file is None or kind_of(file) != "file":
        return None
    parameters = task.x_star.tolist(), None if space is None else space.to_dict()
    return json.dumps([task.name, file, *parameters])


def is_own(name: str, options: Mapping[str, Any]) -> bool:
    """Whether a task of this name and these options is a user's renderer."""
    return "command" in options or is_reference(name)


def is_function(name: str, options: Mapping[str, Any]) -> bool:
    """Whether it is a function of a file or a module of the user's."""
    return is_own(name, options) and not {"command", "suite"} & set(options)


def make_renderer_task(name: str, seed: int, options: Mapping[str, Any]) -> RendererTask:
    """Task of the function ``FILE.py:NAME`` or ``module:NAME``; or of the program in `options`.

    options: `space`, path of a TOML file; `target`, path of a picture; `command`, a template, see
        `renderers.template`, and `timeout` in seconds.
    """
    known = ("space", "target", *(("command", "timeout") if "command" in options else ()))
    for option in options:
        if option not in known:
            raise OptionError(f"{name} has no option {option!r}; it has {', '.join(known)}")
    given = Space.read(options["space"]) if "space" in options else None
    if "command" not in options:
        function = FunctionRenderer(name)
        space = function.space_or(given)
        return RendererTask(name, function, space, seed, options.get("target"))
    if given is None:
        raise OptionError("a command needs a space (--space FILE.toml), its parameters and ranges")
    program = CommandRenderer(options["command"], given, options.get("timeout", TIMEOUT))
    return RendererTask(name, program, given, seed, options.get("target"))
