"""What was meant by a flag or a name that a command does not know."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Iterable
from importlib import import_module

from fide_plugins.errors import did_you_mean

__all__ = ["flags_of", "suggestion"]

_UNKNOWN = "unrecognized arguments: "
_CHOICE = re.compile(r"invalid choice: '([^']*)' \(choose from (.*)\)$")


def suggestion(
    message: str, flags: Iterable[str], others: Callable[[], dict[str, Iterable[str]]]
) -> str:
    """End of a message of argparse: the flag or the value that is meant; empty if nothing is close.

    flags: that the command has.  others: gives those of other commands, by command.
    """
    choice = _CHOICE.search(message)
    if choice is not None:
        return did_you_mean(choice[1], re.findall(r"[^', ]+", choice[2]))
    if not message.startswith(_UNKNOWN):
        return ""
    known = list(flags)
    for word in message.removeprefix(_UNKNOWN).split():
        flag = word.partition("=")[0]
        if not flag.startswith("--"):
            continue
        if where := [name for name, those in others().items() if flag in those]:
            return f"; {flag} is of {' and '.join(f'fide {name}' for name in where[:3])}"
        if close := did_you_mean(flag, known):
            return close.replace("'", "")
    return ""


def flags_of(commands: Iterable[str]) -> dict[str, Iterable[str]]:
    """Flags of each command, by its name."""
    found: dict[str, Iterable[str]] = {}
    for name in commands:
        parser = argparse.ArgumentParser(add_help=False)
        import_module(f"fide_plugins.cli.{name}_command").add_arguments(parser)
        found[name] = [flag for action in parser._actions for flag in action.option_strings]
    return found
