r"""Look at your renderer before a fit: what each parameter changes, how long a render takes, noise.

    fide check scene.py:render
    fide check scene.py:render --space space.toml --out runs/scene
    fide check --command 'povray scene.pov +O{out} Declare=Sun={sun}' --space space.toml
    fide check voronoi

RENDERER is FILE.py:NAME (or module:NAME), or the name of a built-in task; --command is a program,
once for each view. Some 10 renders are made, and 2 to 5 for each parameter.

The report says what is in the images, how long a render takes, whether two renders of the same
parameters are equal, which parameters change nothing, which renders failed, and how many renders
and workers to plan. check.png shows each parameter low, middle and high, the others at the middle.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fide_lab.cli.running import notices, write_figure
from fide_plugins.cli.arguments import add_space_argument, own_renderer, path, whole
from fide_plugins.cli.terminal import (
    USAGE_ERRORS,
    note,
    paragraph,
    plain,
    warnings_as_notes,
)

_SIDE = 112  # pixels of a built-in task


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fide check``."""
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("renderer", nargs="?", metavar="RENDERER",
                      help="FILE.py:NAME, or see: fide list tasks")  # fmt: skip
    what.add_argument("--command", action="append", metavar="'PROGRAM ...'", dest="templates",
                      help="your program; once for each view")  # fmt: skip
    add_space_argument(parser)
    add = parser.add_argument
    add("--workers", type=whole(1), metavar="N", help="renders at a time (as many as cores)")
    add("--timeout", metavar="TIME", help="of a render: 60, 2m (none; for --command 60)")
    add("--out", type=path, metavar="DIR", help="where check.png goes (runs/check-NAME)")
    add("--json", action="store_true", help="print one JSON object instead of the report")


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Execute the command; returns the exit code."""
    from fide_lab.checking import as_data, check, figure, lines

    who = "fide check"
    with warnings_as_notes(who):
        try:
            name, render, space, timeout = _renderer(args)
            facts = check(render, space, workers=args.workers, timeout=timeout)
            picture = None
            if facts.images:
                out = args.out or Path("runs", f"check-{_file_name(name)}")
                out.mkdir(parents=True, exist_ok=True)
                picture = write_figure(who, out / "check.png", lambda: figure(name, facts))
        except USAGE_ERRORS as error:
            note(f"{who}: {paragraph(error)}")
            return 2
    if args.json:
        shown = {**as_data(name, facts), "picture": picture and str(picture)}
        print(json.dumps(shown, allow_nan=False), flush=True)
    else:
        print("\n".join(map(paragraph, lines(name, facts))), flush=True)
        if picture is not None:
            print(f"look at {plain(picture)}", flush=True)
    return 0 if facts.images else 1


def _renderer(args: argparse.Namespace) -> tuple[str, Callable[[Any], object], Any, Any]:
    """Name, function, space and time limit of a render."""
    found = own_renderer(args, args.renderer, args.templates, raw=False)
    if found is not None:
        own, space, limit = found
        return own.name, own, space, limit + 5 if args.templates else limit  # its output is known
    import fide_tasks

    with notices("fide_tasks"):
        task = fide_tasks.make(args.renderer, _SIDE)

    def render(params: dict[str, Any]) -> Any:
        return task.render(task.space.encode(params)[None])[0]

    return args.renderer, render, task.space, args.timeout


def _file_name(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "_", Path(name.split(":")[0]).stem).strip("_") or "renderer"
