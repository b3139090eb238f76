"""Say what is installed here, and which encoders and losses can be used.

With --verbose, try every task and optimizer, too.
"""

from __future__ import annotations

import argparse
import json
from importlib import import_module
from typing import Any

from fide_plugins.cli.terminal import plain
from fide_plugins.runtime import machine
from fide_plugins.runtime.machine import EXTRAS, install_command


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fide doctor``."""
    parser.add_argument("--verbose", action="store_true", help="try everything (10 to 40 seconds)")
    parser.add_argument("--json", action="store_true", help="as --verbose, in one line of JSON")


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Execute the command; returns the exit code."""
    everything = args.verbose or args.json
    facts = examine(everything)
    print(json.dumps(facts) if args.json else _text(facts))
    if not everything:
        print("\nfide doctor --verbose tries every task and optimizer, too")
    return 0


def examine(everything: bool = True) -> dict[str, Any]:
    """Versions, machine, and for each name None or the reason why it cannot be used."""
    import torch  # noqa: F401  `machine` reports devices only if it is imported

    opencv = None
    try:
        import_module("fide_plugins.runtime.opencv")
    except ImportError as error:
        opencv = plain(error)
    return {
        "versions": machine.versions(),
        "machine": machine.machine(),
        "opencv": {"OpenCV": opencv},
        **{kind: problems(kind) for kind in (KINDS if everything else WITH_WEIGHTS)},
        "extras": {extra: machine.version_of(packages[0]) for extra, packages in EXTRAS.items()},
    }


def _text(facts: dict[str, Any]) -> str:
    extras = {
        extra: version or f"not installed: {install_command(extra)}"
        for extra, version in facts["extras"].items()
    }
    computer = {name: "none" if fact is None else fact for name, fact in facts["machine"].items()}
    sections = {**facts, "machine": computer, "extras": extras}
    lines = []
    for title, table in sections.items():
        width = max(map(len, table), default=0)
        lines += ["", title]
        lines += [f"  {name:{width}}  {'ok' if v is None else v}" for name, v in table.items()]
    return "\n".join(lines[1:])


KINDS = ("tasks", "optimizers", "encoders", "losses")
WITH_WEIGHTS = ("encoders", "losses")  # kinds that may need weights; to try them takes seconds
_SIDE = 32  # pixels, side of the test images


def names(kind: str) -> list[str]:
    """Names of all tasks, optimizers, encoders or losses."""
    import fide_tasks
    from fide_lab import optimizers
    from fide_plugins import encoders, losses

    lists = {
        "tasks": fide_tasks, "optimizers": optimizers, "encoders": encoders, "losses": losses
    }  # fmt: skip
    return sorted(lists[kind].names())


def problems(kind: str) -> dict[str, str | None]:
    """For each name of a kind: None if it can be used here, otherwise the reason why not.

    Each task renders a frame, each encoder and each loss processes an image, each optimizer
    proposes candidates.  Nothing is downloaded.
    """
    results: dict[str, str | None] = {}
    for name in names(kind):
        try:
            _try(kind, name)
            results[name] = None
        except Exception as error:  # any error is a reason
            results[name] = plain(error) or type(error).__name__
    return results


def _try(kind: str, name: str) -> None:
    """Render a frame, process an image, or propose candidates; raises what is wrong."""
    import numpy as np

    import fide_tasks
    from fide_lab import optimizers
    from fide_plugins import encoders, losses

    image = np.linspace(0, 1, _SIDE * _SIDE * 3, dtype=np.float32).reshape(_SIDE, _SIDE, 3)
    match kind:
        case "tasks":
            fide_tasks.make(name, size=_SIDE).check()
        case "optimizers":
            optimizers.make(name, 2, image, seed=0).ask()
        case "encoders":
            encoders.make(name)(image[None])
        case "losses":
            losses.make(name, image)(image[None])
