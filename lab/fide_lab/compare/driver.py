"""Execute the missing runs of a comparison: in this process, in several, or on a Dask cluster."""

from __future__ import annotations

import os
import secrets
import shutil
import traceback
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from fide_lab.compare.directory import ERROR, LOCK, ComparisonDirectory, State, examine
from fide_lab.compare.plan import Checked, Plan, RunKey, target_file
from fide_lab.run import Interrupted, prepare as prepare_run
from fide_lab.run.kept_target import read_target
from fide_plugins.errors import CheckpointError, OptionError
from fide_plugins.fitting.processes import Processes
from fide_plugins.fitting.rendering import Failed, Rendered, Task
from fide_plugins.recording.signals import Interrupts
from fide_plugins.recording.storage import read_run
from fide_plugins.runtime import files, machine
from fide_plugins.runtime.machine import missing
from fide_plugins.runtime.messages import said_once
from fide_plugins.validation.points import whole_number

# -- one run ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """Outcome of one run.

    key: which run.
    kind: "done" now; "kept", finished before; "failed"; "interrupted", and saved; "busy", locked by
        another process.
    note: what failed, or why the run was repeated.
    totals: totals in `run.json` of a finished run.
    signum: the signal that interrupted the run.
    """

    key: RunKey
    kind: Literal["done", "kept", "failed", "interrupted", "busy"]
    note: str = ""
    totals: dict[str, Any] | None = None
    signum: int = 0


def _run_one(plan: Plan, checked: Checked, out: Path, command: list[str], key: RunKey) -> Outcome:
    """Execute or continue one run of the comparison in `out`; one that fails does not raise."""
    folder = out / key.folder
    folder.mkdir(parents=True, exist_ok=True)
    with files.locked(folder / LOCK) as mine:
        if not mine:
            return Outcome(key, "busy", "another process executes it")
        state = examine(folder, checked.settings[key], checked.versions)
        if state.kind == "finished":
            return Outcome(key, "kept", totals=_totals(folder))
        note = ""
        if state.why:
            _clear(folder)
            damaged = "it was damaged: " if state.kind == "damaged" else ""
            note = f"repeated, because {damaged}{state.why}"
        # of an earlier attempt: from here on the run counts as unfinished, not as failed
        (folder / ERROR).unlink(missing_ok=True)
        try:
            attempt = partial(_prepare, plan, key, out, command)
            with said_once(set(checked.said)):
                try:
                    run = attempt()
                except CheckpointError as error:
                    _clear(folder)
                    run, note = attempt(), f"repeated, because it could not be continued: {error}"
            run.execute()
        except Interrupted as stop:
            return Outcome(key, "interrupted", str(stop), signum=stop.signum)
        except (Exception, SystemExit) as error:
            files.write_text(folder / ERROR, traceback.format_exc())
            return Outcome(key, "failed", f"{type(error).__name__}: {error}")
        return Outcome(key, "done", note, _totals(folder))


def _prepare(plan: Plan, key: RunKey, out: Path, command: list[str]) -> Any:
    configuration = plan.configuration(key.configuration)
    kept = read_target(target_file(out, key.task))
    return prepare_run(
        key.task,
        configuration.name,
        key.loss,
        configuration.budget or plan.budget,
        key.seed,
        size=plan.size,
        task_seed=plan.task_seed,
        task_options=plan.task_options,
        options=plan.options_of(configuration),
        out=out / key.folder,
        resume=True,
        command=command,
        keep=plan.keep,
        target=None if kept is None else kept.image,
    )


def _clear(folder: Path) -> None:
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != LOCK:
            path.unlink()


def _totals(folder: Path) -> dict[str, Any] | None:
    run = read_run(folder)
    return None if run is None else run.get("totals")


# -- all of them -----------------------------------------------------------------------------------


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
        keys, out = list(self.checked.settings), self.directory.path
        work = partial(_run_one, self.plan, self.checked._replace(targets={}), out, self.command)
        lost = partial(_note_lost, out)
        if self.dask is not None:
            yield from _on_dask(work, keys, self.dask, out, lost)
        elif self.jobs > 1:
            with Interrupts() as interrupts:
                arriving = in_processes(work, keys, self.jobs, lost)
                while True:
                    with interrupts.stoppable():
                        outcome = next(arriving, None)
                    if outcome is None:
                        return
                    yield outcome
        else:
            yield from map(work, keys)


def _note_lost(out: Path, key: RunKey, why: str) -> Outcome:
    folder = out / key.folder
    folder.mkdir(parents=True, exist_ok=True)  # it may have died before the run began
    files.write_text(folder / ERROR, why + "\n")
    return Outcome(key, "failed", why)


# -- in several processes --------------------------------------------------------------------------


def in_processes(
    work: Callable[[Any], Any], items: Sequence[Any], jobs: int, lost: Callable[[Any, str], Any]
) -> Iterator[Any]:
    """Results of `work` for all items by `jobs` processes, in order of completion.

    lost: gives the result for an item whose process died, of it and how it did.

    When the iterator is closed the processes are killed; runs go on from their last checkpoints.
    """
    pool = Processes(partial(_worked, work), min(jobs, len(items)))
    waiting, running = list(reversed(items)), dict[Task, Any]()
    try:
        while waiting or running:
            while waiting and len(running) < pool.number:
                item = waiting.pop()
                running[pool.submit(item)] = item
            for task in wait(running, return_when=FIRST_COMPLETED).done:
                item, made = running.pop(task), pool.outcome(task)
                yield lost(item, made.reason) if isinstance(made, Failed) else made.image
    finally:
        pool.close()


def _worked(work: Callable[[Any], Any], item: Any) -> Rendered:
    return Rendered(work(item), 0.0)


# -- by Dask ---------------------------------------------------------------------------------------


_TIMEOUT = 20.0  # seconds until the scheduler must answer, and until one worker must be there


@contextmanager
def _connected(address: str) -> Iterator[Any]:
    """Client of the cluster whose scheduler has this address; closed at the end.

    Raises DependencyError (an ImportError) without Dask, OptionError (a ValueError) if the
    scheduler does not answer, there is no worker, or one has several threads: what runs beside
    something else in one process would share its state, and distort its measured time.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise missing("dask", "--dask needs the package distributed") from error
    try:
        client: Any = Client(address, timeout=_TIMEOUT, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TimeoutError) as error:
        raise OptionError(f"no Dask scheduler answers at {address}: {error}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_TIMEOUT)
        except TimeoutError as error:
            raise OptionError("the Dask cluster has no worker; start one: dask worker") from error
        workers = client.scheduler_info(n_workers=-1)["workers"]
        if wrong := [name for name, worker in workers.items() if worker["nthreads"] != 1]:
            raise OptionError(
                f"the Dask worker {wrong[0]} must have one thread: dask worker --nthreads 1"
            )
        yield client


def _on_dask(
    work: Callable[[Any], Any],
    items: Sequence[Any],
    address: str,
    out: Path,
    lost: Callable[[Any, str], Any],
) -> Iterator[Any]:
    """As `in_processes`, by the workers of a cluster, which all see the folder `out`."""
    with _connected(address) as client:
        from distributed import as_completed

        probe = out / f".probe.{secrets.token_hex(6)}.tmp"
        probe.touch()
        try:
            for name, seen in client.run(_sees, str(probe)).items():
                if not seen:
                    raise OptionError(
                        f"the Dask worker {name} does not see {out.resolve()}; name a folder that "
                        "all machines share under the same path"
                    )
        finally:
            probe.unlink()
        futures = {client.submit(work, item, pure=False): item for item in items}
        completed: Any = as_completed(futures, loop=client.loop)  # type: ignore[no-untyped-call]
        for future in completed:
            if future.status == "finished":
                yield future.result()
            else:
                yield lost(futures[future], f"Dask gave up this run: {future.exception()!r}")


def _sees(path: str) -> bool:
    return Path(path).exists()
