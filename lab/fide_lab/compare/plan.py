"""The plan of a comparison: tasks x losses x configurations x seeds, checked before the start.

A configuration is an optimizer with its options, written as one word.

>>> Configuration.parse("cma:popsize=50:restarts=none").options
{'popsize': 50, 'restarts': 'none'}
>>> Configuration.parse("nevergrad:CMA").name
'nevergrad:CMA'
>>> Configuration.parse("dibo:budget=2000").budget
2000
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from fide_lab import optimizers
from fide_lab.run import Keep
from fide_lab.run.kept_target import KeptTarget
from fide_lab.run.prepare import kept_of, make_optimizer, make_task, settings_of, target_of
from fide_lab.run.task import Task, is_function
from fide_lab.run.versions import of_losses, of_models, of_weights
from fide_plugins import losses as losses_module
from fide_plugins.errors import OptionError
from fide_plugins.learning.posterior import with_model
from fide_plugins.recording.directory import of_files
from fide_plugins.renderers import FunctionRenderer
from fide_plugins.runtime.messages import said_once, warn_user
from fide_plugins.validation.options import check_names, parse_key_value
from fide_plugins.validation.points import whole_number


@dataclass(frozen=True)
class Configuration:
    """An optimizer with its options.

    label: the word itself, with its options in alphabetical order; the name in tables and plots.
    name: name of the optimizer in `fide_lab.optimizers`.
    options: options of this configuration only, such as popsize.
    budget: number of renders; None for the budget of the comparison.
    """

    label: str
    name: str
    options: dict[str, Any]
    budget: int | None = None

    @classmethod
    def parse(cls, text: str) -> Configuration:
        """Parse a text ``NAME[:KEY=VALUE]...``; `budget` is one of the keys.

        Raises OptionError (a ValueError).
        """
        name, words = split(text)
        pairs = [parse_key_value(word) for word in words]
        options = dict(sorted(pairs))
        misplaced = "=" in name and ".py:" not in name  # only a path may have one
        if not name or misplaced or len(options) < len(pairs):
            raise OptionError(f"an optimizer is NAME or NAME:KEY=VALUE:..., not {text!r}")
        label = ":".join([name, *(f"{key}={value}" for key, value in options.items())])
        budget = options.pop("budget", None)
        if budget is not None and (not isinstance(budget, int) or budget < 1):
            raise OptionError(f"budget must be a whole number >= 1, not {budget!r}, in {text!r}")
        return cls(label, name, options, budget)


def split(text: str) -> tuple[str, list[str]]:
    """Split ``NAME[:KEY=VALUE]...`` into the name and its options; both may hold colons.

    >>> split("nevergrad:CMA:popsize=50"), split("fide:encoder=vgg19:relu4_1")
    (('nevergrad:CMA', ['popsize=50']), ('fide', ['encoder=vgg19:relu4_1']))
    >>> split("/runs/a=1/mine.py:Search:step=2")
    ('/runs/a=1/mine.py:Search', ['step=2'])
    """
    first, *words = text.split(":")
    parts = [first]  # the name, then options
    for word in words:
        key, equals, _ = word.partition("=")
        if equals and key.isidentifier():
            parts.append(word)
        else:
            parts[-1] += f":{word}"
    return parts[0], parts[1:]


def as_file_name(text: str) -> str:
    """Encode `text` as a file name; different texts give different names.

    >>> as_file_name("nevergrad:CMA"), as_file_name("cma:popsize=50"), as_file_name("..")
    ('nevergrad+CMA', 'cma+popsize=50', '%2E%2E')
    """
    name = quote(text, safe="=").replace("%3A", "+")
    return name.replace(".", "%2E") if name.startswith(".") else name


TARGETS = "targets"
"""Folder of the targets in that of a comparison."""


class RunKey(NamedTuple):
    """Identity of one run within a comparison.

    task, loss: their names.
    configuration: label of the optimizer and its options.
    seed: of the optimizer.
    """

    task: str
    loss: str
    configuration: str
    seed: int

    @property
    def folder(self) -> Path:
        """Run directory, relative to that of the comparison."""
        names = (as_file_name(name) for name in (self.task, self.loss, self.configuration))
        return Path("cells", *names, f"seed-{self.seed}")

    def __str__(self) -> str:
        return f"{self.task} {self.loss} {self.configuration} seed {self.seed}"


class Checked(NamedTuple):
    """Result of `Plan.check`.

    settings: settings that define each run, in the order of the plan.
    targets: that of each task, as it is to be kept.
    versions: of the user's files, of losses, and of pretrained weights, by reference.
    said: warnings that making the optimizers gave, which their runs need not repeat.
    """

    settings: dict[RunKey, dict[str, Any]]
    targets: dict[str, KeptTarget]
    versions: dict[str, str]
    said: frozenset[str]


@dataclass(frozen=True)
class Plan:
    """What a comparison runs.

    For one task and one loss, all configurations have the same target, box and budget, but for
    those that name their own.  Runs with the same seed form a pair.

    tasks, losses: names; configurations: optimizers with options; seeds: number of seeds, from 0.
    budget: renders of each run.
    size, task_seed, task_options: arguments with which each task is made.
    options: options of all optimizers; an optimizer that lacks one of them is refused.
    metrics: losses that measure every improvement, whichever loss is minimized.

    Raises OptionError (a ValueError) if a list is empty or names something twice.
    """

    tasks: tuple[str, ...]
    configurations: tuple[Configuration, ...]
    losses: tuple[str, ...] = ("mse",)
    seeds: int = 10
    budget: int = 5000
    size: int = 224
    task_seed: int = 0
    task_options: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    metrics: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        whole_number("seeds", self.seeds, 1)
        whole_number("budget", self.budget, 1)
        labels = tuple(configuration.label for configuration in self.configurations)
        named = {"task": self.tasks, "optimizer": labels, "loss": self.losses}
        for what, names in named.items():
            if not names:
                raise OptionError(f"a comparison needs at least one {what}; name one")
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise OptionError(f"the {what} {twice[0]!r} is named twice; name each once")

    @property
    def keep(self) -> Keep:
        """What every run records."""
        return Keep(metrics=self.metrics, summary=False, checkpoint=False)

    def runs(self) -> Iterator[RunKey]:
        """All runs, seeds outermost, so that the finished runs can be compared at any time."""
        for seed in range(self.seeds):
            for task in self.tasks:
                for loss in self.losses:
                    for configuration in self.configurations:
                        yield RunKey(task, loss, configuration.label, seed)

    def configuration(self, label: str) -> Configuration:
        """The configuration with this label."""
        return next(each for each in self.configurations if each.label == label)

    def options_of(self, configuration: Configuration) -> dict[str, Any]:
        """Options of the plan, overridden by those of the configuration."""
        return {**self.options, **configuration.options}

    def check_optimizers(self) -> None:
        """Check names and options of all optimizers; nothing is rendered.

        Raises UnknownNameError, OptionError (both ValueErrors), ImportError for a missing package.
        """
        given = ("self", "dim", "target", "loss", "seed")
        for configuration in self.configurations:
            options, known = self.options_of(configuration), optimizers.options(configuration.name)
            check_names(options, given, "is a setting of the comparison, not of one optimizer")
            unknown = sorted(set(self.options) - set(known)) if known else []
            if unknown:
                raise OptionError(
                    f"{configuration.name} has no option {unknown[0]!r}; give it to one optimizer "
                    f"only, as NAME:{unknown[0]}={options[unknown[0]]}"
                )
            optimizers.check(configuration.name, options)

    def check(self, out: Path) -> Checked:
        """Make every task, loss and optimizer once; returns settings of all runs, and targets.

        out: folder of the comparison, which may have the targets of an earlier call.

        Raises UnknownNameError, OptionError and other ValueErrors, ImportError for a missing
        package, OSError for missing weights.  Warns of a budget below one population, and of
        what the optimizers warn of, once of each.
        """
        self.check_optimizers()
        settings: dict[RunKey, dict[str, Any]] = {}
        targets: dict[str, KeptTarget] = {}
        versions, said = self._versions(), set[str]()
        for name in self.tasks:
            task = make_task(name, self.size, self.task_seed, self.task_options)
            target = target_of(task, target_file(out, name))
            targets[name] = kept_of(task, target)
            mine = [key for key in self.runs() if key.task == name]
            named = {*(key.loss for key in mine), *self.metrics}
            losses = {loss: losses_module.make(loss, target) for loss in named}
            versions |= of_losses(losses.values())
            for key in mine:
                configuration = self.configuration(key.configuration)
                if key._replace(seed=0) not in settings:
                    with said_once(said):
                        versions |= self._try(configuration, task, target, key.loss)
                known = settings_of(
                    task, target, configuration.name, losses[key.loss].name,
                    configuration.budget or self.budget, key.seed, self.task_options,
                    self.options_of(configuration), self.keep,
                )  # fmt: skip
                settings[key] = json.loads(json.dumps(known))  # as it is read back
        ordered = {key: settings[key] for key in self.runs()}
        return Checked(ordered, targets, versions, frozenset(said))

    def _versions(self) -> dict[str, str]:
        """Fingerprints of the user's files that it names, by reference."""
        found = {each.name: optimizers.source_of(each.name) for each in self.configurations}
        for task in self.tasks:
            if is_function(task, self.task_options):
                found[task] = FunctionRenderer(task).fingerprint
        return of_files(found) | of_models(*map(self.options_of, self.configurations))

    def _try(
        self, configuration: Configuration, task: Task, target: Any, loss: str
    ) -> dict[str, str]:
        """Make an optimizer, which raises if it cannot be; fingerprint of its encoder's weights."""
        name, options = configuration.name, self.options_of(configuration)
        budget = configuration.budget or self.budget
        with_model(options, task)  # a model may be of another version
        optimizer = make_optimizer(name, task, target, loss, 0, budget, options)
        if budget < optimizer.popsize:
            warn_user(
                f"the budget of {budget} renders is below one population of {configuration.label}, "
                f"which is {optimizer.popsize} for {task.dim} parameters: the optimizer never "
                "learns; give more renders, or a smaller popsize"
            )
        return of_weights(optimizer)


def target_file(out: Path, task: str, kind: str = "ckpt") -> Path:
    """File of the target of a task in the folder of a comparison; kind: "ckpt" or "png"."""
    return out / TARGETS / f"{as_file_name(task)}.{kind}"
