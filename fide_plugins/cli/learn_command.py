"""Learn once what pictures say of a renderer's parameters, for every later picture.

    fide learn scene.py:render --renders 100000 --out scene.fide --workers 2
    fide learn --command 'povray scene.pov +O{out} Sun={sun}' --space space.toml --out m.fide
    fide learn robot --renders 60000 --time 30m --out robot.fide
    fide fit photo.png --renderer scene.py:render --learned scene.fide

SOURCE is FILE.py:NAME (or module:NAME), a function of your own, or the name of a built-in task. The
renders are kept in MODEL.renders: with --resume the same command goes on where it was interrupted,
and --renders may be larger.
"""

from __future__ import annotations

import argparse
import shlex
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fide_plugins.cli.arguments import add_space_argument, own_renderer, path, setting, whole
from fide_plugins.cli.progress import interval
from fide_plugins.cli.terminal import (
    USAGE_ERRORS,
    complain,
    continuation,
    note,
    paragraph,
    plain,
    warnings_as_notes,
)
from fide_plugins.errors import DeviceError, FideError, OptionError, RenderError

_EVERY = 5.0  # seconds between lines in a terminal
_KEPT = "what was rendered and learned is kept in"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fide learn``."""
    add = parser.add_argument
    add("source", nargs="?", metavar="SOURCE", help="FILE.py:NAME, or see: fide list tasks")
    add("--command", metavar="'PROGRAM ...'", dest="template", help="your program")
    add_space_argument(parser)
    add("--timeout", metavar="TIME", help="of a program, such as 60 or 2m (60)")
    add("--renders", type=whole(100), default=100_000, metavar="N",
        help="of random parameters (100000)")  # fmt: skip
    add("--size", type=whole(16), default=64, metavar="PX", help="longer side of images (64)")
    add("--render-size", type=whole(16), metavar="PX",
        help="longer side at which a built-in task renders (that of --size)")  # fmt: skip
    add("--passes", type=whole(1), default=10, metavar="N", help="over the renders, at most (10)")
    add("--time", metavar="TIME", help="how long at most: 90s, 10m, 1h30m")
    add("--workers", type=whole(0), default=1, metavar="N",
        help="processes that render; 0 and 1: this one (1)")  # fmt: skip
    add("--seed", type=whole(0), default=0, metavar="N", help="of parameters and network (0)")
    add("--task-set", type=setting, action="append", default=[], metavar="KEY=VALUE",
        help="any option of the task, such as cells=12; may be repeated")  # fmt: skip
    add("--augment", choices=("none", "render", "photograph"), default="photograph",
        help="how much renders are changed while they are learned: for pictures that the renderer "
        "makes, or for photographs (photograph)")  # fmt: skip
    add("--backgrounds", metavar="FOLDER",
        help="pictures, or 'generated' ones, that are put behind renders which say what they draw "
        "(RGBA, or image and coverage), for photographs")  # fmt: skip
    add("--emulator", action=argparse.BooleanOptionalAction,
        help="a learned renderer, too (where parameters are exchangeable)")  # fmt: skip
    add("--device", default="auto", help="where the network trains: auto, cpu or cuda (auto)")
    add("--out", type=path, required=True, metavar="MODEL", help="file of the model")
    add("--resume", action="store_true", help="go on with the renders that are there")


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Execute the command; returns the exit code."""
    from fide_plugins.learning import learn
    from fide_plugins.recording.signals import Interrupted, Interrupts

    who, begun = "fide learn", False
    with warnings_as_notes(who), Interrupts() as interrupts:
        try:
            arguments = _arguments(args)
            _check_free(args)
            begun = True
            with interrupts.stoppable():  # each file is written at once
                model = learn(**arguments, on_progress=_lines())
        except Interrupted as stop:
            note(f"{who}: {stop}; {_KEPT} {plain(args.out)}.renders")
            note(f"continue with: {continuation(command)}")
            return 128 + stop.signum
        except RenderError as error:
            note(f"{who}: {'it stopped: ' * begun}{paragraph(error)}")
            return _stopped(args, command)
        except USAGE_ERRORS as error:
            if not begun or isinstance(error, OptionError | DeviceError | ImportError):
                return complain(who, error)
            if not isinstance(error, FideError | OSError):
                raise
            note(f"{who}: it stopped: {paragraph(error)}")
            return _stopped(args, command)
    print(model.report)
    print(f"use it with: --learned {plain(shlex.quote(str(args.out)))}")
    return 0


def _stopped(args: argparse.Namespace, command: list[str]) -> int:
    if any(Path(f"{args.out}.renders").glob("*.npz")):
        note(f"{_KEPT} {plain(args.out)}.renders")
        note(f"when that is mended, continue with: {continuation(command)}")
    return 1


def _check_free(args: argparse.Namespace) -> None:
    """Raise OptionError if something is there and nobody asked to go on with it."""
    folder = Path(f"{args.out}.renders")
    has_renders = folder.exists()
    if folder.is_dir():  # a call whose renders were all of no use leaves less
        has_renders = any(p.name not in {"settings", ".learn.lock"} for p in folder.iterdir())
    for place, taken in ((args.out, args.out.exists()), (folder, has_renders)):
        if taken and not args.resume:
            raise OptionError(f"{place} is there already; add --resume, or name another --out")


def _arguments(args: argparse.Namespace) -> dict[str, Any]:
    """Arguments of `learn`."""
    from fide_plugins.validation.options import seconds_of

    render, space = _renderer(args)
    same = (
        "renders", "size", "passes", "seed", "augment", "backgrounds", "emulator", "device", "out",
        "workers",
    )  # fmt: skip
    time = None if args.time is None else seconds_of("time", args.time)
    given = {name: getattr(args, name) for name in same}
    return {"render": render, "space": space, "time": time, **given}


def _renderer(args: argparse.Namespace) -> tuple[Any, Any]:
    """What renders, and its space; None for a task, which knows its own."""
    from fide_plugins.runtime.registry import is_reference

    if (args.source is None) == (args.template is None):
        raise OptionError("name either a SOURCE or a --command; see fide learn --help")
    if args.timeout is not None and args.template is None:
        raise OptionError("--timeout is of --command; leave it out")
    if args.render_size is not None and is_reference(args.source or ":"):
        raise OptionError("--render-size is of built-in tasks; leave it out")
    templates = None if args.template is None else [args.template]
    found = own_renderer(args, args.source, templates, raw=False)
    if found is not None:
        return found[:2]
    import fide_tasks

    size = args.render_size or args.size
    return fide_tasks.make(args.source, size, 0, **dict(args.task_set)), None


def _lines() -> Callable[[Any], None]:
    """Lines of progress on standard error: one a pass, and one now and then elsewhere."""
    last = time.monotonic()

    def report(progress: Any) -> None:
        nonlocal last
        late = time.monotonic() - last >= interval(_EVERY)
        rendered = progress.stage == "render" and progress.done == progress.total
        if late or rendered or progress.stage in ("train", "emulate"):
            last = time.monotonic()
            note(_line(progress))

    return report


def _line(progress: Any) -> str:
    """Line about a `LearnProgress`."""
    from fide_plugins.learning.judging import against_prior

    done = f"{progress.done}/{progress.total}"
    match progress.stage:
        case "render":
            return f"renders {done}"
        case "train":
            return f"pass {done}  held-out renders: {against_prior(progress.held_out)}"
        case "emulate":
            explained = f"{1 - progress.held_out:.1%} of the variance explained"
            return f"emulator, pass {done}  held-out renders: {explained}"
        case _:
            return f"judging {done}"
