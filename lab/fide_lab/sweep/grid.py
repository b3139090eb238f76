"""All combinations of the swept options, as comparisons.

A combination of optimizer options is a configuration of a comparison.  A combination of task
options (image size, samples per pixel) is a comparison in its own folder.  Network options are
swept only with presets that have a network.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

from fide_lab.compare import Configuration, Plan
from fide_lab.compare.directory import read_record
from fide_lab.run.renderer_task import is_own
from fide_plugins.errors import OptionError, UnknownNameError
from fide_plugins.options import PRESETS
from fide_plugins.recording.json_record import check_settings

__all__ = ["DEFAULTS", "OPTIONS", "Grid"]

OPTIMIZER = ("preset", "popsize", "encoder")
NETWORK = ("epochs", "steps", "parameter_tokens", "precision")
TASK = ("size", "spp")
OPTIONS = (*OPTIMIZER, *NETWORK, *TASK)
"""Options that can be swept."""
DEFAULTS: Mapping[str, tuple[Any, ...]] = {
    "preset": tuple(PRESETS),
    "epochs": (4,),
    "size": (112,),
}
"""Values of options that are not given; other options have the value of the preset."""


@dataclass(frozen=True)
class Grid:
    """A sweep.

    options: values to sweep by name, of the names in `OPTIONS`.

    Raises OptionError (a ValueError) for an unknown name, no values, a repeated value, network
    options if no preset has a network, or sizes of a user's renderer, which has its own.
    """

    tasks: tuple[str, ...]
    options: Mapping[str, Sequence[Any]]
    loss: str = "mse"
    seeds: int = 3
    budget: int = 2000
    task_seed: int = 0
    task_options: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, values in self.options.items():
            if name not in OPTIONS:
                raise UnknownNameError.of("option to sweep", name, OPTIONS)
            if not values or len(set(values)) < len(values):
                raise OptionError(f"{name} needs values, each once, not {list(values)!r}")
        for preset in self.values("preset"):
            if preset not in PRESETS:
                raise UnknownNameError.of("preset", preset, PRESETS)
        of_network = [name for name in NETWORK if name in self.options]
        if of_network and not any(PRESETS[preset].has_network for preset in self.values("preset")):
            raise OptionError(
                f"{of_network[0]} is an option of the network, and no preset has one "
                f"({', '.join(self.values('preset'))}): leave it out, or add paper"
            )

        self._check_sizes()

    def _check_sizes(self) -> None:
        own = [task for task in self.tasks if is_own(task, self.task_options)]
        sizes = self.options.get("size", ())
        if own and sizes and (len(own) == len(self.tasks) or len(sizes) > 1):
            raise OptionError(
                f"size is for built-in tasks; {own[0]} is a renderer of your own and has its own "
                "size: change it there"
            )

    def values(self, option: str) -> tuple[Any, ...]:
        """Values of an option; empty if it has the value of each preset."""
        return tuple(self.options.get(option, DEFAULTS.get(option, ())))

    def configurations(self) -> list[Configuration]:
        """Every combination of optimizer options."""
        configurations: dict[str, Configuration] = {}
        for preset in self.values("preset"):
            possible = (*OPTIMIZER[1:], *NETWORK * PRESETS[preset].has_network)
            names = [name for name in possible if self.values(name)]
            for chosen in product(*(self.values(name) for name in names)):
                pairs = zip(("preset", *names), (preset, *chosen), strict=True)
                text = ":".join(("fide", *(f"{key}={value}" for key, value in pairs)))
                configuration = Configuration.parse(text)
                configurations[configuration.label] = configuration
        return list(configurations.values())

    def check(self, out: Path) -> None:
        """Check that this sweep can extend the one in the folder `out`, if there is one.

        Raises RunDirectoryError (a FileExistsError) if that has another loss, budget or target.
        """
        mine = self._comparable({**self.task_options}, (self.loss,), self.budget, self.task_seed)
        for path in sorted(out.glob("*/study.json")):
            record = read_record(path.parent)
            theirs = record["settings"] if record else {}
            there = self._comparable(
                *(theirs[key] for key in ("task_options", "metrics", "budget", "task_seed"))
            )
            check_settings(there, mine, f"{out} holds a sweep")

    @staticmethod
    def _comparable(
        task_options: Mapping[str, Any], losses: Sequence[str], budget: int, task_seed: int
    ) -> dict[str, Any]:
        """Settings that all comparisons of a sweep have in common."""
        options = {key: value for key, value in task_options.items() if key not in TASK}
        return {
            "task options": options, "loss": losses[0], "budget": budget, "task seed": task_seed,
        }  # fmt: skip

    def plans(self) -> Iterator[tuple[str, Plan]]:
        """Every combination of task options: name of its folder, and its plan."""
        for chosen in product(self.values("size"), self.values("spp") or (None,)):
            size, spp = chosen
            options = self.task_options if spp is None else {**self.task_options, "spp": spp}
            name = f"size-{size}" + ("" if spp is None else f"-spp-{spp}")
            yield name, Plan(
                self.tasks, tuple(self.configurations()), (self.loss,), self.seeds, self.budget,
                size, self.task_seed, options, metrics=(self.loss,),
            )  # fmt: skip
