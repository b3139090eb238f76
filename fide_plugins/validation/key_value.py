"""Options on the command line: ``key=value``."""

from __future__ import annotations

import json
from typing import Any

from fide_plugins.errors import OptionError

__all__ = ["parse"]


def parse(text: str) -> tuple[str, Any]:
    """Key and value of ``key=value``, the value as bool, int, float or str, whichever fits first.

    A value in brackets is a list, as JSON has it, ``groups=[[0,1],[2,3]]``, and one in braces a
    dictionary, ``x0={"azimuth": 30}``.

    Raises OptionError (a ValueError) for anything else.

    >>> parse("popsize=50"), parse("sigma0=1e-1"), parse("restarts=none"), parse("fast=true")
    (('popsize', 50), ('sigma0', 0.1), ('restarts', 'none'), ('fast', True))
    """
    key, equals, value = text.partition("=")
    if not equals or not key.isidentifier():
        raise OptionError(f"key=value, not {text!r}")
    words: dict[str, Any] = {"true": True, "false": False}
    if value.lower() in words:
        return key, words[value.lower()]
    if value.startswith(("[", "{")):
        return key, _from_json(text, value)
    for kind in (int, float):
        try:
            return key, kind(value)
        except ValueError:
            continue
    return key, value


def _from_json(text: str, value: str) -> Any:
    try:
        return json.loads(value)
    except ValueError as error:
        rule = "a value in brackets is a list such as [[0,1],[2,3]]"
        if value.startswith("{"):
            rule = 'a value in braces is a dictionary such as {"azimuth": 30}, names in quotes'
        raise OptionError(f"{text!r}: {rule} ({error})") from error
