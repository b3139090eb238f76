"""List names, one per line; encoders and losses that cannot be used here with the reason.

The heading of the scenes that are not of the paper goes to standard error.
"""

from __future__ import annotations

import argparse

from fide_lab.cli.doctor_command import KINDS, WITH_WEIGHTS, names, problems
from fide_plugins.cli.terminal import note


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fide list``."""
    parser.add_argument("kind", choices=KINDS, help="what to list")


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Execute the command; returns the exit code."""
    if args.kind in WITH_WEIGHTS:
        found = problems(args.kind)
        width = max(map(len, found))
        for name, problem in found.items():
            print(name if problem is None else f"{name:{width}}  not here: {problem}")
        return 0
    print("\n".join(names(args.kind)), flush=True)
    if args.kind == "tasks":
        import fide_tasks

        # to standard error: it is no name, so not for a program that reads them
        note("\nmore scenes, not of the paper:")
        print("\n".join(n for n in fide_tasks.names("all") if n not in fide_tasks.names()))
    return 0
