"""`fide fit IMAGE --model NAME`: a picture, fitted with a task that draws it."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fide_lab.cli.watch_command import page_of
from fide_plugins.cli.arguments import free_directory, optimizer_options, setting, whole
from fide_plugins.cli.terminal import complain
from fide_plugins.errors import OptionError

if TYPE_CHECKING:
    from fide_tasks.base import Task

MODELS = {"voronoi": "cells", "spline": "control_points"}
"""Models, and the option of each that sets its number of elements."""
_BUDGET, _SIDE = 5000, 224
_SIGMA0 = 0.03  # around a start that was read off the picture: right but for its details


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fide fit`` with --model."""
    model = parser.add_argument_group("a model that draws")
    add = model.add_argument
    add("--cells", type=whole(1), metavar="N", help="number of cells of voronoi (8)")
    add("--control-points", type=whole(2), metavar="N", help="number of points of spline (7)")
    add("--model-set", type=setting, action="append", metavar="KEY=VALUE",
        help="any other option of the model")  # fmt: skip
    add("--start", choices=("picture", "center"),
        help="where fide begins (picture; other optimizers: center)")  # fmt: skip


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Execute the command; returns the exit code."""
    from fide_lab import run as harness
    from fide_lab.cli.running import execute_run

    if args.model not in MODELS:
        return complain("fide fit", f"--model is {' or '.join(MODELS)}, not {args.model}")
    if len(args.targets) > 1:
        return complain("fide fit", f"--model draws one picture, not {len(args.targets)}")
    image = args.targets[0]
    args.optimizer = args.optimizer or "fide"

    def prepare() -> harness.Run:
        import fide_tasks
        from fide_plugins.validation import images

        options = _model_options(args)
        picture = images.load(image, max_side=args.size or _SIDE)
        task = fide_tasks.make(args.model, target=picture, **options)
        out = free_directory(args, f"{Path(image).stem}-{args.model}")
        started = _start_options(args, task) | optimizer_options(args)
        run = harness.prepare(
            task, args.optimizer, args.loss, args.budget or _BUDGET, args.seed,
            task_options=options, options=started, out=out, resume=args.resume, command=command,
        )  # fmt: skip
        if args.live:
            page.enter_context(page_of(out))
        return run

    with ExitStack() as page:
        return execute_run(args, command, prepare, args.model, more=_more)


def _more(run: Any, result: Any) -> dict[str, Any]:
    """What the JSON of a fit has beside that of a run."""
    status, x = run.optimizer.status, result.x_best
    return {
        "params": None if x is None else run.task.space.decode(x),
        "status": None if status is None else status.code,
    }


def _start_options(args: argparse.Namespace, task: Task) -> dict[str, Any]:
    """Options x0 and sigma0 of the optimizer; OptionError if --start asks for what is not there."""
    if args.start == "center" or (args.start is None and args.optimizer != "fide"):
        return {}
    if args.optimizer != "fide":
        why = f"--start picture is for the optimizer fide; {args.optimizer} begins at the center"
        raise OptionError(why)
    x0 = task.start()
    if x0 is not None:
        return {"x0": x0.tolist(), "sigma0": _SIGMA0}
    if args.start is None:
        return {}
    raise OptionError("--start picture: the model reads no start off this picture; use center")


def _model_options(args: argparse.Namespace) -> dict[str, Any]:
    """Options of the model; OptionError for an option of another model."""
    options = dict(args.model_set or ())
    for model, option in MODELS.items():
        value = getattr(args, option)
        if value is not None:
            if model != args.model:
                flag = "--" + option.replace("_", "-")
                raise OptionError(f"{flag} belongs to --model {model}, not {args.model}")
            options[option] = value
    return options
