"""The plan that runs the problems of a suite."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from fide_lab.compare.plan import Configuration, Plan, RunKey
from fide_lab.run import Keep
from fide_lab.run.prepare import make_task, target_of
from fide_lab.suite.definition import Suite
from fide_plugins.errors import OptionError


@dataclass(frozen=True)
class SuitePlan(Plan):
    """The runs of a suite: one for each problem and configuration.

    The number of a target is the seed of the optimizer.  `size` and `task_seed` have no meaning.
    """

    suite: Suite | None = None

    @property
    def keep(self) -> Keep:
        """What every run records: its curve."""
        return Keep(summary=False, checkpoint=False)

    def runs(self) -> Iterator[RunKey]:
        """All runs, targets outermost, so that finished problems can be compared at any time."""
        assert self.suite is not None
        for problem in self.tasks:
            scene, number = self.suite.parts(problem)
            for configuration in self.configurations:
                yield RunKey(problem, self.suite.scenes[scene].loss, configuration.label, number)


def plan(
    suite: Suite,
    configurations: Iterable[Configuration],
    scenes: list[str],
    targets: int,
    budget: int | None = None,
) -> SuitePlan:
    """Plan of these scenes with their first `targets` targets; budget: None for the suite's.

    Raises OptionError (a ValueError) for an optimizer with a budget of its own.
    """
    configurations = tuple(configurations)
    check_budgets(configurations)
    return SuitePlan(
        tasks=tuple(suite.problems(scenes, targets)),
        configurations=configurations,
        losses=tuple(dict.fromkeys(suite.scenes[scene].loss for scene in scenes)),
        seeds=targets,
        budget=budget or suite.budgets[-1],
        task_options={"suite": suite.name},
        suite=suite,
    )


def check_budgets(configurations: Iterable[Configuration]) -> None:
    """Raise OptionError if an optimizer has a budget of its own."""
    for configuration in configurations:
        if configuration.budget is not None:
            raise OptionError(
                f"{configuration.label} has a budget of its own, and the optimizers of a suite are "
                "read at the same renders; leave it out, or give all of them --budget "
                f"{configuration.budget}"
            )


def unavailable(suite: Suite, scenes: Iterable[str]) -> dict[str, str]:
    """Those of the scenes that cannot be rendered on this machine, and why."""
    why: dict[str, str] = {}
    for scene in scenes:
        try:
            target_of(make_task(suite.problem_of(scene, 0), 0, 0, {"suite": suite.name}))
        except (ImportError, OSError, RuntimeError, ValueError) as error:
            why[scene] = str(error)
    return why
