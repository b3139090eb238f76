"""A suite as data: its scenes, targets, budgets, and what counts as solved."""

from __future__ import annotations

import shlex
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Any

from fide_plugins.errors import OptionError, UnknownNameError

_FOLDER = Path(str(resources.files("fide_lab.suite")))


@dataclass(frozen=True)
class Scene:
    """A scene of a suite.

    group: such as "folding"; loss: that is minimized; solved: the loss from which on it is solved.
    task: name in `fide_tasks`, made with `size` in pixels and `options`; or None for a program,
        whose task has the `options` of `run.task.make_renderer_task`.
    targets: seeds of the tasks.
    metric: by which it is judged in place of the loss: "error" for a scene of `suite.foreign`.
    """

    name: str
    group: str
    loss: str
    solved: float
    task: str | None
    size: int
    options: Mapping[str, Any]
    targets: tuple[int, ...] = ()
    metric: str | None = None


@dataclass(frozen=True)
class Suite:
    """A suite: problems are scenes x targets, each with the name ``SCENE-NUMBER``.

    budgets: renders at which results are read; the last is that of a run.
    targets: seeds of the tasks, the same for every scene, but for those that have fewer.
    """

    name: str
    budgets: tuple[int, ...]
    targets: tuple[int, ...]
    scenes: Mapping[str, Scene]

    def __reduce__(self) -> tuple[Any, ...]:
        return read, (self.name,)

    def problem_of(self, scene: str, number: int) -> str:
        """Name of the problem that is this scene with the target of that number, from 0."""
        return f"{scene}-{number}"

    def parts(self, problem: str) -> tuple[str, int]:
        """Undo `problem_of`; UnknownNameError for a name that is none of the suite's problems."""
        scene, _, number = problem.rpartition("-")
        targets = self.scenes[scene].targets if scene in self.scenes else ()
        if number not in map(str, range(len(targets))):
            raise UnknownNameError(
                f"unknown problem {problem!r} of {self.name}: write SCENE-NUMBER, a number from 0 "
                f"to {len(targets or self.targets) - 1} and a scene of {', '.join(self.scenes)}"
            )
        return scene, int(number)

    def problem(self, name: str) -> tuple[Scene, int]:
        """Scene and target's seed of a problem; raises as `parts`."""
        scene, number = self.parts(name)
        return self.scenes[scene], self.scenes[scene].targets[number]

    def problems(self, scenes: Iterable[str], targets: int) -> list[str]:
        """Names of the problems of these scenes, the first `targets` of each, targets outermost."""
        return [
            self.problem_of(scene, number)
            for number in range(targets)
            for scene in scenes
            if number < len(self.scenes[scene].targets)
        ]

    def chosen(self, scenes: list[str] | None, targets: int | None) -> tuple[list[str], int]:
        """Scenes in the order of the suite and number of targets; None: all.

        Raises OptionError (a ValueError) for names or numbers that the suite has not.
        """
        for name in scenes or ():
            if name not in self.scenes:
                raise UnknownNameError.of(f"scene of {self.name}", name, self.scenes)
        if targets is not None and targets > len(self.targets):
            raise OptionError(f"{self.name} has {len(self.targets)} targets, not {targets}")
        wanted = list(self.scenes) if scenes is None else scenes
        return [name for name in self.scenes if name in wanted], targets or len(self.targets)


def names() -> list[str]:
    """Names of all suites."""
    return sorted(path.stem for path in _FOLDER.glob("*.toml"))


@cache
def read(name: str) -> Suite:
    """The suite `name`; UnknownNameError (a ValueError) for none."""
    if name not in names():
        raise UnknownNameError.of("suite", name, names())
    data = tomllib.loads((_FOLDER / f"{name}.toml").read_text("utf-8"))
    budgets, targets = tuple(data["budgets"]), tuple(data["targets"])
    if "scenes_of" in data:
        others = read(data["scenes_of"]).scenes
        scenes = {key: replace(scene, targets=targets) for key, scene in others.items()}
    else:
        scenes = {key: _scene(key, entry, targets) for key, entry in data["scenes"].items()}
    return Suite(name, budgets, targets, MappingProxyType(scenes))


def _scene(name: str, entry: dict[str, Any], targets: tuple[int, ...]) -> Scene:
    options = dict(entry.get("options", {}))
    if "command" in entry:
        folder = _FOLDER / "scenes"
        word = shlex.quote(str(folder).replace("{", "{{").replace("}", "}}"))  # of a template
        options["command"] = entry["command"].replace("{scenes}", word)
        options["space"] = str(folder / entry["space"])
    return Scene(
        name, entry["group"], entry["loss"], float(entry["solved"]), entry.get("task"),
        int(entry.get("size", 0)), MappingProxyType(options), targets[: entry.get("problems")],
        entry.get("metric"),
    )  # fmt: skip
