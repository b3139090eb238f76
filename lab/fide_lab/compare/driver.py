"""Execute the missing runs of a comparison: in this process, in several, or on a Dask cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Any

from fide_lab.compare import processes
from fide_lab.compare.cluster import on_dask
from fide_lab.compare.directory import ComparisonDirectory
from fide_lab.compare.one_run import ERROR, Outcome, State, run_one
from fide_lab.compare.plan import Checked, Plan, RunKey
from fide_lab.run import Interrupted, Progress
from fide_plugins.errors import OptionError
from fide_plugins.recording.signals import Interrupts
from fide_plugins.runtime import files, machine
from fide_plugins.validation.points import whole_number

__all__ = ["Comparison", "prepare", "run"]

Item = tuple[RunKey, dict[str, Any]]
OnOutcome = Callable[[Outcome], None]
OnProgress = Callable[[RunKey, Progress], None]


def run(plan: Plan, out: str | os.PathLike[str], **settings: Any) -> list[Outcome]:
    """Execute the missing runs of `plan` in the directory `out`.

    settings: jobs (processes, at most one a core), dask (address of a scheduler, in their place),
        resume (whether `out` may hold runs of this plan) and command (a command line to record).

    Raises OptionError (a ValueError), RunDirectoryError (a FileExistsError) or OSError.
    """
    return prepare(plan, out, **settings).execute()


def prepare(
    plan: Plan,
    out: str | os.PathLike[str],
    *,
    jobs: int = 1,
    dask: str | None = None,
    resume: bool = False,
    command: Sequence[str] = (),
) -> Comparison:
    """Check the plan, and make or reopen the directory; nothing is run yet.

    out: a new directory or, with `resume`, one with the same settings.
    jobs: number of processes, at most one per core; 1 is this process.
    dask: address of a Dask scheduler, which replaces `jobs`.
    command: command line to record.

    Raises what `Plan.check` and `ComparisonDirectory` raise, and OptionError (a ValueError).
    """
    whole_number("jobs", jobs, 1)
    if jobs > machine.cores():
        raise OptionError(
            f"{jobs} jobs on {machine.cores()} cores: use at most one process per core, "
            "or the measured seconds mean nothing"
        )
    if dask is not None and jobs > 1:
        raise OptionError("jobs are processes of this machine; with Dask, start more workers")
    checked = plan.check(Path(out))
    directory = ComparisonDirectory(out, plan, checked, resume=resume)
    return Comparison(plan, directory, checked, jobs, dask, list(command))


class Comparison:
    """A comparison that is ready to start or to continue; made by :func:`prepare`."""

    def __init__(
        self,
        plan: Plan,
        directory: ComparisonDirectory,
        checked: Checked,
        jobs: int,
        dask: str | None,
        command: list[str],
    ) -> None:
        self._plan, self._directory, self._checked = plan, directory, checked
        self._jobs, self._dask, self._command = jobs, dask, command

    @property
    def out(self) -> Path:
        """Its directory."""
        return self._directory.path

    @property
    def states(self) -> dict[RunKey, State]:
        """State of each run before the start."""
        return self._directory.states

    def execute(
        self, on_outcome: OnOutcome | None = None, on_progress: OnProgress | None = None
    ) -> list[Outcome]:
        """Execute the missing runs; returns the outcome of each run.

        on_outcome: called when a run ends.
        on_progress: called during each run, in one process only.

        Raises Interrupted (a KeyboardInterrupt) after SIGINT or SIGTERM, when all is saved.
        """
        workers = {"jobs": self._jobs, "dask": self._dask is not None, "cores": machine.cores()}
        self._directory.begin(self._command, workers)
        outcomes = []
        try:
            with closing(self._outcomes(on_progress)) as arriving:
                for outcome in arriving:
                    if outcome.kind == "interrupted":
                        raise Interrupted(outcome.signum)
                    outcomes.append(outcome)
                    if on_outcome is not None:
                        on_outcome(outcome)
        finally:
            with suppress(OSError):
                self._directory.end()
        return outcomes

    def _outcomes(self, on_progress: OnProgress | None) -> Generator[Outcome, None, None]:
        items = list(self._checked.settings.items())
        checked = self._checked
        work = partial(_work, self._plan, self.out, self._command, checked.versions, checked.said)
        lost = partial(_lost, self.out)
        if self._dask is not None:
            yield from on_dask(work, items, self._dask, self.out, lost)
        elif self._jobs > 1:
            yield from _interruptible(processes.in_processes(work, items, self._jobs, lost))
        else:
            for item in items:
                report = None if on_progress is None else partial(on_progress, item[0])
                yield work(item, report)


def _work(
    plan: Plan,
    out: Path,
    command: list[str],
    versions: dict[str, str],
    said: frozenset[str],
    item: Item,
    on_progress: Callable[[Progress], None] | None = None,
) -> Outcome:
    key, settings = item
    return run_one(plan, key, settings, out, command, on_progress, versions, said)


def _lost(out: Path, item: Item, why: str = "the process that ran it died") -> Outcome:
    """Outcome of a run whose process died."""
    folder = out / item[0].folder
    folder.mkdir(parents=True, exist_ok=True)  # it may have died before the run began
    files.write_text(folder / ERROR, why + "\n")
    return Outcome(item[0], "failed", why)


def _interruptible(outcomes: Iterator[Outcome]) -> Iterator[Outcome]:
    """The same outcomes; a signal raises `Interrupted` while the next one is awaited."""
    with Interrupts() as interrupts:
        while True:
            with interrupts.stoppable():
                outcome = next(outcomes, None)
            if outcome is None:
                return
            yield outcome
