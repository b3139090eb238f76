"""Names of the tasks, and the factory that loads a task only when it is asked for."""

from __future__ import annotations

import importlib
import inspect
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fide_tasks.base import Task

_TASKS = {  # name: module that holds it, class
    "arm": ("fide_tasks.arm", "Arm"),
    "ball": ("fide_tasks.ball", "Ball"),
    "beads": ("fide_tasks.beads", "Beads"),
    "lamps": ("fide_tasks.lamps", "Lamps"),
    "lens": ("fide_tasks.lens", "Lens"),
    "robot": ("fide_tasks.robot", "Robot"),
    "san_miguel": ("fide_tasks.san_miguel", "SanMiguel"),
    "spline": ("fide_tasks.spline", "Spline"),
    "sprites": ("fide_tasks.sprites", "Sprites"),
    "stick_figure": ("fide_tasks.stick_figure", "StickFigure"),
    "triangles": ("fide_tasks.triangles", "Triangles"),
    "voronoi": ("fide_tasks.voronoi", "Voronoi"),
}
_GROUPS = {  # of tasks
    "paper": ("beads", "robot", "san_miguel", "spline", "voronoi"),
    "exchangeable": ("lamps", "sprites"),
    "folding": ("arm", "lens", "stick_figure"),
    "smooth": ("ball",),
    "many": ("triangles",),
}


def names(group: str = "paper") -> list[str]:
    """Return the names of the tasks of a group, sorted.

    "paper" are the scenes of the paper. The others belong to this package: "exchangeable", scenes
    of several objects in any order; "folding", scenes with several basins; "smooth", scenes for
    comparison with solvers of least-squares problems; "many", scenes of hundreds of parameters.
    "all" are all tasks.

    Raises ValueError for an unknown group.
    """
    if group == "all":
        return sorted(_TASKS)
    if group not in _GROUPS:
        raise ValueError(f"group must be one of all, {', '.join(_GROUPS)}, not {group!r}")
    return sorted(_GROUPS[group])


def options(name: str) -> dict[str, Any]:
    """Return the options of the task `name` with their defaults.

    Raises ValueError for an unknown name.
    """
    return _option_defaults(_load(name))


def make(name: str, size: int | tuple[int, int] = 224, seed: int = 0, **options: Any) -> Task:
    """Make the task `name`.

    `size` is the side of the square image, or (height, width), in pixels. What a generated target
    shows depends on `seed` and on options of the task, not on the resolution; it is drawn with all
    options that change images. `options` are the task's own; `options(name)` lists them. A task
    that takes a picture as `target=` renders at that picture's size, whatever `size` says.

    Raises ValueError for an unknown name or option, and for a value outside its range.
    """
    task_class = _load(name)
    known = _option_defaults(task_class)
    for option in options:
        if option not in known:
            has = f"it has {', '.join(sorted(known))}"
            raise ValueError(f"{name} has no option {option!r}; {has}")
    task: Task = task_class(size, seed, **options)
    return task


def _load(name: str) -> Any:
    if name not in _TASKS:
        known = f"the tasks: {', '.join(names('all'))}"
        raise ValueError(f"no task is named {name!r}; {known}")
    module, attribute = _TASKS[name]
    return getattr(importlib.import_module(module), attribute)


def _option_defaults(task_class: Any) -> dict[str, Any]:
    """Keyword-only arguments of the constructor, and of those it passes **options on to."""
    defaults: dict[str, Any] = {}
    for cls in task_class.__mro__:
        if "__init__" in vars(cls):
            parameters = inspect.signature(cls.__init__).parameters.values()
            own = {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}
            defaults = {**own, **defaults}
            if all(p.kind is not p.VAR_KEYWORD for p in parameters):
                break
    return defaults
