"""Makes a run from names and options: task, target, loss, optimizer and directory, all checked."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from fide_lab import optimizers
from fide_lab.optimizers import Named
from fide_lab.run.kept_target import KeptTarget, read_target, same_target, write_target
from fide_lab.run.loop import Keep, Run
from fide_lab.run.result import RunResult
from fide_lab.run.task import Task, TaskInfo, is_own, make_renderer_task, source_of_target
from fide_lab.run.versions import of_losses, of_models, of_weights, that_count_later
from fide_lab.suite import read as read_suite
from fide_plugins import losses as losses_module
from fide_plugins.errors import CheckpointError, FideError, OptionError, RenderError
from fide_plugins.learning.posterior import with_model
from fide_plugins.recording.directory import (
    RunDirectory,
    of_files,
)
from fide_plugins.recording.record import Progress, Record
from fide_plugins.recording.storage import TARGET_FILE, is_saved
from fide_plugins.runtime.registry import fingerprint_of, own_name
from fide_plugins.types import Float32, Optimizer
from fide_plugins.validation.images import as_target
from fide_plugins.validation.options import check_names
from fide_plugins.validation.points import whole_number


def run(
    task: str | Task,
    optimizer: Named = "fide",
    loss: str | Callable[..., object] = "mse",
    budget: int = 5000,
    seed: int = 0,
    *,
    on_progress: Callable[[Progress], None] | None = None,
    **settings: Any,
) -> RunResult:
    """Fit `task` with `optimizer`, and return the result.

    loss, budget, seed, settings: as of `prepare`, which raises their errors.
    on_progress: called after each piece of a generation.  Raises also what `Run.execute` raises.
    """
    return prepare(task, optimizer, loss, budget, seed, **settings).execute(on_progress)


def prepare(
    task: str | Task,
    optimizer: Named = "fide",
    loss: str | Callable[..., object] = "mse",
    budget: int = 5000,
    seed: int = 0,
    *,
    size: int | tuple[int, int] = 224,
    task_seed: int = 0,
    task_options: Mapping[str, Any] | None = None,
    options: Mapping[str, Any] | None = None,
    out: str | os.PathLike[str] | None = None,
    resume: bool = False,
    checkpoint_every: float = 5.0,
    command: Sequence[str] | None = None,
    keep: Keep | None = None,
    target: Float32 | None = None,
) -> Run:
    """Check the arguments, and make or resume a run; one image is rendered at most.

    task: name in `fide_tasks`; ``FILE.py:NAME``, or any name with the option `command`, for a
        user's renderer, see `task.make_renderer_task`; or a `Task`.
    size, task_seed, task_options: arguments of a task that is given by name.
    optimizer: name in `fide_lab.optimizers`; ``FILE.py:NAME`` for a user's class; or a class, or a
        function ``(dim, target, loss=, seed=, **options)`` that makes an optimizer.
    loss: name in `fide_plugins.losses`, or a callable images -> (n,).
    budget: number of candidates to render.
    seed: of the optimizer, and of the renderer's noise.
    options: of the optimizer, such as popsize.
    out: run directory; None writes nothing.
    resume: continue the run in `out` if there is one, perhaps with a larger budget.
    checkpoint_every: seconds between checkpoints, at least twenty times the time to write one.
    command: command line to record.
    keep: what to record in addition to the losses; see `Keep`.
    target: picture to be found, (H, W, 3), which all runs of a comparison have; None: the task's.

    Raises OptionError, ImageError, RunDirectoryError, CheckpointError and other ValueErrors;
    OSError if `out` cannot be written; ImportError if the task needs a package that is not there;
    RenderError if its target cannot be rendered.
    """
    budget, seed = whole_number("budget", budget, 1), whole_number("seed", seed, 0)
    task_options, options, keep = dict(task_options or {}), dict(options or {}), keep or Keep()
    _check_optimizer(optimizer, options, out is not None)
    if isinstance(task, str):
        task = make_task(task, size, task_seed, task_options)
    resumed = resume and out is not None and is_saved(out)
    search_options = with_model(options, task, resumed=resumed and optimizer == "fide")
    file = None if out is None or target is not None else Path(out) / TARGET_FILE
    target = target_of(task, file) if target is None else as_target(target)
    judge = losses_module.resolve(loss, target, device=options.get("device"))
    metrics = {name: losses_module.make(name, target) for name in keep.metrics}
    settings = settings_of(
        task, target, optimizer, judge.name, budget, seed, task_options, options, keep
    )
    searcher = make_optimizer(optimizer, task, target, loss, seed, budget, search_options)
    record, directory = Record(), None
    if out is not None:
        versions = of_files({TaskInfo.of(task).name: fingerprint_of(task)}) | of_models(options)
        if isinstance(optimizer, str):
            versions |= of_files({optimizer: optimizers.source_of(optimizer)})
        versions |= of_weights(searcher) | of_losses([judge, *metrics.values()])
        versions = that_count_later(versions, optimizer == "fide", judge.name, resumed)
        directory = RunDirectory(
            out, settings, resume=resume, command=command, sources=versions,
            may_change=() if "budget" in optimizers.options(optimizer) else ("budget",),
        )  # fmt: skip
        kept = None if file is None else kept_of(task, target)
        record, searcher = _started(directory, record, searcher, budget, kept)
    return Run(
        task, target, searcher, judge, settings, record, directory, checkpoint_every, keep, metrics,
    )  # fmt: skip


def _check_optimizer(optimizer: Named, options: Mapping[str, Any], saved: bool) -> None:
    """Raise ValueError for an optimizer that is no use, and for options that the run gives it."""
    given: tuple[str, ...] = ("loss", "seed")
    if saved and not isinstance(optimizer, str):
        why = "a run with a directory needs its optimizer by name, to load it again"
        raise OptionError(f"{why}; see fide_lab.optimizers.register")
    optimizers.options(optimizer)  # raises
    if isinstance(optimizer, str):
        given = ("self", "dim", "target", *given)  # a user's callable may name its own options so
    check_names(options, given, "is an argument of the run, not an option of its optimizer")


def _started(
    directory: RunDirectory,
    record: Record,
    searcher: Optimizer,
    budget: int,
    kept: KeptTarget | None,
) -> tuple[Record, Optimizer]:
    """Record and optimizer that the directory holds, or those given; the run is written down."""
    name, device = directory.settings["optimizer"], directory.settings["options"].get("device")
    with ExitStack() as refused:
        refused.callback(directory.close)
        saved = directory.restore(lambda path: optimizers.load(name, path, device=device))
        dim = searcher.dim
        record, searcher = (record, searcher) if saved is None else saved
        if searcher.dim != dim:
            raise CheckpointError(f"{directory.path}: an optimizer of {searcher.dim} parameters")
        if record.evaluations > budget:
            raise OptionError(
                f"the run in {directory.path} has {record.evaluations} renders already, and the "
                f"budget is {budget}: give at least as many, or name another directory"
            )
        if kept is not None:
            write_target(directory.path / TARGET_FILE, kept)
        directory.write_run()
        refused.pop_all()
    return record, searcher


def make_task(
    name: str, size: int | tuple[int, int], seed: int, options: Mapping[str, Any]
) -> Task:
    """Make the task `name` of `fide_tasks`, that of a user's renderer, or a problem of a suite.

    Raises OptionError (a ValueError) for an option that a problem of a suite does not leave open.
    """
    if "suite" in options:
        if others := sorted(options.keys() - {"suite"}):
            raise OptionError(f"a suite is fixed and does not leave {others[0]} open; leave it out")
        scene, target_seed = read_suite(options["suite"]).problem(name)
        if scene.metric is not None:
            from fide_lab.suite.foreign import make

            return make(scene.name, target_seed)
        return make_task(scene.task or scene.name, scene.size, target_seed, scene.options)
    if is_own(name, options):
        return make_renderer_task(name, seed, options)
    import fide_tasks

    return fide_tasks.make(name, size, seed, **options)


def settings_of(
    task: Task,
    target: Float32,
    optimizer: Named,
    loss: str,
    budget: int,
    seed: int,
    task_options: Mapping[str, Any],
    options: Mapping[str, Any],
    keep: Keep,
) -> dict[str, Any]:
    """What defines a run, as its directory records it: other settings, another run."""
    info = TaskInfo.of(task)
    settings = {
        "task": info.name, "task_seed": info.seed,
        "task_options": {k: v for k, v in task_options.items() if k not in info.incidental_options},
        "size": list(target.shape[:2]), "dim": task.dim,
        "target": hashlib.sha256(target.tobytes()).hexdigest()[:16],
        "optimizer": optimizer if isinstance(optimizer, str) else own_name(optimizer),
        "options": dict(options), "loss": loss, "budget": budget, "seed": seed,
    }  # fmt: skip
    if info.renderer is not None:
        settings["renderer"] = info.renderer
    if info.search_space is not None:
        settings["space"] = info.search_space.to_dict()
    if keep.metrics:
        settings["metrics"] = list(keep.metrics)
    return settings


def make_optimizer(
    optimizer: Named,
    task: Task,
    target: Float32,
    loss: str | Callable[..., object],
    seed: int,
    budget: int,
    options: dict[str, Any],
) -> Optimizer:
    """The optimizer for a task; it is told the budget if that is one of its options."""
    options = {"loss": loss, "seed": seed, **options}
    if "budget" in optimizers.options(optimizer):
        options = {"budget": budget, **options}
    space = TaskInfo.of(task).search_space or task.dim
    return optimizers.make(optimizer, space, target, **options)


def kept_of(task: Task, target: Float32) -> KeptTarget:
    """A target of the task, as it is kept."""
    return KeptTarget(target, source_of_target(task))


def target_of(task: Task, file: Path | None = None) -> Float32:
    """The target of a task: the one kept in the file, if it is from the same source or equal to it.

    Raises RenderError if the renderer fails; CheckpointError if the file is damaged.
    """
    kept = None if file is None else read_target(file)
    if kept is not None and kept.source is not None and kept.source == source_of_target(task):
        return kept.image
    try:
        target = as_target(task.target)
    except FideError:
        raise
    except RuntimeError as error:
        raise RenderError(f"{own_name(task)} failed to render its target: {error}") from error
    return kept.image if kept is not None and same_target(kept.image, target) else target
