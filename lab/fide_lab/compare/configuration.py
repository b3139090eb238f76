"""An optimizer with its options, written as one word.

>>> Configuration.parse("cma:popsize=50:restarts=none").options
{'popsize': 50, 'restarts': 'none'}
>>> Configuration.parse("nevergrad:CMA").name
'nevergrad:CMA'
>>> Configuration.parse("dibo:budget=2000").budget
2000
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

from fide_plugins.errors import OptionError
from fide_plugins.validation.options import parse_key_value

__all__ = ["Configuration", "as_file_name", "split"]


@dataclass(frozen=True)
class Configuration:
    """An optimizer with its options.

    label: the word itself, with its options in alphabetical order; the name in tables and plots.
    name: name of the optimizer in `fide_lab.optimizers`.
    options: options of this configuration only, such as popsize.
    budget: number of renders; None for the budget of the comparison.
    """

    label: str
    name: str
    options: dict[str, Any]
    budget: int | None = None

    @classmethod
    def parse(cls, text: str) -> Configuration:
        """Parse a text ``NAME[:KEY=VALUE]...``; `budget` is one of the keys.

        Raises OptionError (a ValueError).
        """
        name, words = split(text)
        pairs = [parse_key_value(word) for word in words]
        options = dict(sorted(pairs))
        misplaced = "=" in name and ".py:" not in name  # only a path may have one
        if not name or misplaced or len(options) < len(pairs):
            raise OptionError(f"an optimizer is NAME or NAME:KEY=VALUE:..., not {text!r}")
        label = ":".join([name, *(f"{key}={value}" for key, value in options.items())])
        budget = options.pop("budget", None)
        if budget is not None and (not isinstance(budget, int) or budget < 1):
            raise OptionError(f"budget must be a whole number >= 1, not {budget!r}, in {text!r}")
        return cls(label, name, options, budget)


def split(text: str) -> tuple[str, list[str]]:
    """Split ``NAME[:KEY=VALUE]...`` into the name and its options; both may hold colons.

    >>> split("nevergrad:CMA:popsize=50"), split("fide:encoder=vgg19:relu4_1")
    (('nevergrad:CMA', ['popsize=50']), ('fide', ['encoder=vgg19:relu4_1']))
    >>> split("/runs/a=1/mine.py:Search:step=2")
    ('/runs/a=1/mine.py:Search', ['step=2'])
    """
    first, *words = text.split(":")
    parts = [first]  # the name, then options
    for word in words:
        key, equals, _ = word.partition("=")
        if equals and key.isidentifier():
            parts.append(word)
        else:
            parts[-1] += f":{word}"
    return parts[0], parts[1:]


def as_file_name(text: str) -> str:
    """Encode `text` as a file name; different texts give different names.

    >>> as_file_name("nevergrad:CMA"), as_file_name("cma:popsize=50"), as_file_name("..")
    ('nevergrad+CMA', 'cma+popsize=50', '%2E%2E')
    """
    name = quote(text, safe="=").replace("%3A", "+")
    return name.replace(".", "%2E") if name.startswith(".") else name
