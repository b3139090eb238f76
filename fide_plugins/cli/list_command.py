"""List names, one a line."""

from __future__ import annotations

import argparse

__all__ = ["add_arguments", "execute"]

_KINDS = ("tasks", "optimizers", "encoders", "losses")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fide list``."""
    parser.add_argument("kind", choices=_KINDS, help="what to list")


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Run it; returns the exit code."""
    print("\n".join(names(args.kind)))
    return 0


def names(kind: str) -> list[str]:
    """Names of all things of that kind."""
    import fide_tasks
    from fide_plugins import encoders, losses, optimizers

    lists = {"tasks": fide_tasks, "optimizers": optimizers, "encoders": encoders, "losses": losses}
    return sorted(lists[kind].names())
