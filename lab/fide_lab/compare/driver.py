"""Execute the missing runs of a comparison: in this process, in several, or on a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import secrets
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from fide_lab.compare.directory import ComparisonDirectory
from fide_lab.compare.one_run import ERROR, Outcome, State, run_one
from fide_lab.compare.plan import Checked, Plan, RunKey
from fide_lab.run import Interrupted
from fide_plugins.errors import OptionError
from fide_plugins.recording.signals import Interrupts
from fide_plugins.runtime import files, machine
from fide_plugins.runtime.machine import connected
from fide_plugins.validation.points import whole_number

Lost = Callable[[Any], Any]


def in_processes(
    work: Callable[[Any], Any], items: Sequence[Any], jobs: int, lost: Lost
) -> Iterator[Any]:
    """Results of `work` for all items by `jobs` processes, in order of completion.

    work: a function that can be pickled.
    lost: gives the result for an item whose process died.

    When the iterator is closed, or an exception is raised into it, the processes are told to stop.
    Results that still arrive are dropped: the work has written them to files.
    """
    waiting, workers = list(reversed(items)), [_Worker() for _ in range(min(jobs, len(items)))]
    idle, running = list(workers), dict[Future[Any], tuple[_Worker, Any]]()
    try:
        while waiting or running:
            while waiting and idle:
                worker, item = idle.pop(), waiting.pop()
                try:
                    running[worker.submit(work, item)] = worker, item
                except BrokenProcessPool:  # the process died while it was idle
                    worker.restart()
                    idle.append(worker)
                    yield lost(item)
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                worker, item = running.pop(future)
                idle.append(worker)
                try:
                    result = future.result()
                except BrokenProcessPool:
                    worker.restart()
                    result = lost(item)
                yield result
    finally:
        _stop(workers)


def _stop(workers: Sequence[_Worker]) -> None:
    """Tell all workers to save and stop, and wait for them; a second Ctrl-C does not wait."""
    try:
        for worker in workers:
            worker.signal(signal.SIGTERM)
        for worker in workers:
            worker.join()
    except BaseException:
        for worker in workers:
            worker.signal(getattr(signal, "SIGKILL", signal.SIGTERM))
        raise


class _Worker:
    def __init__(self) -> None:
        self._pool, self._pid = _pool(), 0

    def submit(self, work: Callable[[Any], Any], item: Any) -> Future[Any]:
        self._pid = self._pid or self._pool.submit(os.getpid).result()  # for `signal`
        return self._pool.submit(_busy, work, item)

    def restart(self) -> None:
        self._pool.shutdown(wait=False)
        self._pool, self._pid = _pool(), 0

    def signal(self, signum: int) -> None:
        if self._pid:
            with suppress(ProcessLookupError):
                os.kill(self._pid, signum)

    def join(self) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)


def _pool() -> ProcessPoolExecutor:
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, context, initializer=_begin)


_AT_WORK = threading.Lock()


def _busy(work: Callable[[Any], Any], item: Any) -> Any:
    with _AT_WORK:
        return work(item)


def _begin() -> None:
    """In a new process: leave the terminal's process group, and end when the parent ends."""
    if hasattr(os, "setpgid"):
        os.setpgid(0, 0)
    threading.Thread(target=_follow, daemon=True).start()


def _follow() -> None:
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)  # the work in progress saves its state and stops
    with _AT_WORK:
        os._exit(1)


def on_dask(
    work: Callable[[Any], Any],
    items: Sequence[Any],
    address: str,
    out: Path,
    lost: Callable[[Any, str], Any],
) -> Iterator[Any]:
    """Results of `work` for all items, in order of completion.

    work: a function that can be pickled.
    out: a folder that every worker must see.
    lost: gives the result for an item that Dask gives up, from the item and the reason.
    """
    with connected(address) as client:
        from distributed import as_completed

        _check(client, out)
        futures = {client.submit(work, item, pure=False): item for item in items}
        completed: Any = as_completed(futures, loop=client.loop)  # type: ignore[no-untyped-call]
        for future in completed:
            if future.status == "finished":
                yield future.result()
            else:
                yield lost(futures[future], f"Dask gave up this run: {future.exception()!r}")


def _check(client: Any, out: Path) -> None:
    probe = out / f".probe.{secrets.token_hex(6)}.tmp"
    probe.touch()
    try:
        for name, seen in client.run(_sees, str(probe)).items():
            if not seen:
                raise OptionError(
                    f"the Dask worker {name} does not see {out.resolve()}; name a folder that all "
                    "machines share under the same path"
                )
    finally:
        probe.unlink()


def _sees(path: str) -> bool:
    return Path(path).exists()


Item = tuple[RunKey, dict[str, Any]]


def run(plan: Plan, out: str | os.PathLike[str], **settings: Any) -> list[Outcome]:
    """Execute the missing runs of `plan` in the directory `out`.

    settings: of `prepare`.
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


@dataclass(frozen=True, eq=False)
class Comparison:
    """A comparison that is ready to start or to continue; made by :func:`prepare`."""

    plan: Plan
    directory: ComparisonDirectory
    checked: Checked
    jobs: int
    dask: str | None
    command: list[str]

    @property
    def states(self) -> dict[RunKey, State]:
        """State of each run before the start."""
        return self.directory.states

    def execute(self, on_outcome: Callable[[Outcome], None] | None = None) -> list[Outcome]:
        """Execute the missing runs; returns the outcome of each run.

        on_outcome: called when a run ends.

        Raises Interrupted (a KeyboardInterrupt) after SIGINT or SIGTERM, when all is saved.
        """
        workers = {"jobs": self.jobs, "dask": self.dask is not None, "cores": machine.cores()}
        self.directory.begin(self.command, workers)
        outcomes = []
        try:
            with closing(self._outcomes()) as arriving:
                for outcome in arriving:
                    if outcome.kind == "interrupted":
                        raise Interrupted(outcome.signum)
                    outcomes.append(outcome)
                    if on_outcome is not None:
                        on_outcome(outcome)
        finally:
            with suppress(OSError):
                self.directory.end()
        return outcomes

    def _outcomes(self) -> Generator[Outcome, None, None]:
        items = list(self.checked.settings.items())
        out, checked = self.directory.path, self.checked
        work = partial(_work, self.plan, out, self.command, checked.versions, checked.said)
        lost = partial(_note_lost, out)
        if self.dask is not None:
            yield from on_dask(work, items, self.dask, out, lost)
        elif self.jobs > 1:
            yield from _interruptible(in_processes(work, items, self.jobs, lost))
        else:
            yield from map(work, items)


def _work(
    plan: Plan,
    out: Path,
    command: list[str],
    versions: dict[str, str],
    said: frozenset[str],
    item: Item,
) -> Outcome:
    key, settings = item
    return run_one(plan, key, settings, out, command, versions, said)


def _note_lost(out: Path, item: Item, why: str = "the process that ran it died") -> Outcome:
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
