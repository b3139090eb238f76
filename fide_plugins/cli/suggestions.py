"""What was meant by a flag or a name that a command does not know."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches
from itertools import takewhile

from fide_plugins.errors import did_you_mean

__all__ = ["suggestion"]

_MISSING = "the following arguments are required: "
_UNKNOWN = "unrecognized arguments: "
_MISTYPED = 0.75  # similarity of names, from which on one is taken for the other
_CHOICE = re.compile(r"invalid choice: '([^']*)' \(choose from (.*)\)$")


def suggestion(
    message: str,
    parser: argparse.ArgumentParser,
    others: Callable[[], Mapping[str, argparse.ArgumentParser]],
    words: Sequence[str] = (),
) -> str:
    """End of a message of argparse: the flag or the value that is meant; empty if nothing is close.

    parser: of the command.  others: gives those of all commands, by name;
    they take a while, and are asked only if no flag of this one is close.  words: that were given.
    """
    if message.startswith(_MISSING):
        return _taken(parser, words)
    choice = _CHOICE.search(message)
    if choice is not None:
        return did_you_mean(choice[1], re.findall(r"[^', ]+", choice[2]))
    if not message.startswith(_UNKNOWN):
        return ""
    for word in message.removeprefix(_UNKNOWN).split():
        flag = word.partition("=")[0]
        if not flag.startswith("--"):
            continue
        name, own = flag[2:], [one[2:] for one in _flags(parser) if one.startswith("--")]
        if not get_close_matches(name, own, 1, _MISTYPED) and (
            where := [command for command, other in others().items() if flag in _flags(other)]
        ):
            return f"; {flag} is of {' and '.join(f'fide {command}' for command in where[:3])}"
        if close := get_close_matches(name, own, 1):
            return f"; did you mean --{close[0]}?"
    return ""


def _taken(parser: argparse.ArgumentParser, words: Sequence[str]) -> str:
    """Which option has taken the argument that is missing, as one with several values does."""
    greedy = {flag for one in parser._actions if one.nargs == "+" for flag in one.option_strings}
    for flag, values in ((word, words[i + 1 :]) for i, word in enumerate(words) if word in greedy):
        taken = list(takewhile(lambda value: not value.startswith("-"), values))
        if len(taken) > 1:
            return f"; {flag} has taken {taken[-1]!r}: write {flag}={','.join(taken[:-1])}"
    return ""


def _flags(parser: argparse.ArgumentParser) -> list[str]:
    return [flag for action in parser._actions for flag in action.option_strings]
