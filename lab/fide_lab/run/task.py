"""What is fitted: the protocol of a task, and what a task may say of itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Protocol

from fide_plugins.runtime.registry import own_name
from fide_plugins.types import Float64

if TYPE_CHECKING:
    from fide_plugins.space import Space

__all__ = ["Task", "TaskInfo"]


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

    name: by default that of its class.
    seed: of the picture that it generates.
    reference: function of a point (dim,) that gives an image (H, W, 3) without noise, by which the
        result is judged.
    incidental_options: names of options that leave every image as it is, such as workers.
    renderer: name of what renders here, for a task whose images depend on what the machine has.
    spp: most samples of a pixel, which `render` obeys.
    search_space: named parameters, for an optimizer that handles integers and choices as such.
    piece: most candidates to render before their results are told; None: the loop's own number.
    advice: function of the name of a loss that gives a sentence, for a user who would do better
        with other settings, or None.
    """

    name: str
    seed: int | None = None
    reference: Callable[[Float64], Any] | None = None
    incidental_options: tuple[str, ...] = ()
    renderer: str | None = None
    spp: int | None = None
    search_space: Space | None = None
    piece: int | None = None
    advice: Callable[[str], str | None] | None = None

    @classmethod
    def of(cls, task: object) -> TaskInfo:
        """What this task says of itself now."""
        optional = [field.name for field in fields(cls) if field.name != "name"]
        said = {name: getattr(task, name) for name in optional if hasattr(task, name)}
        return cls(own_name(task), **said)
