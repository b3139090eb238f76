"""Names of optimizers as figures and tables have room for.

>>> short_names(["cma", "cma:popsize=50", "dibo:batch=64:budget=600"])
{'cma': 'cma', 'cma:popsize=50': 'cma:popsize=50', 'dibo:batch=64:budget=600': 'dibo'}
"""

from __future__ import annotations

from collections.abc import Iterable

__all__ = ["fitted", "short_names"]


def short_names(labels: Iterable[str]) -> dict[str, str]:
    """Each label without the options that all labels of the same optimizer share.

    Different labels stay different: labels of one optimizer differ in some option.
    """
    parts = {label: _split(label) for label in labels}
    shared: dict[str, set[str]] = {}
    for name, options in parts.values():
        shared[name] = shared.get(name, set(options)) & set(options)
    return {
        label: ":".join([name, *(option for option in options if option not in shared[name])])
        for label, (name, options) in parts.items()
    }


def fitted(text: str, room: int) -> str:
    """`text` with at most so many characters.

    >>> fitted("fide-annealing:budget=2000", 12)
    'fide-anneal…'
    """
    return text if len(text) <= room else text[: room - 1] + "…"


def _split(label: str) -> tuple[str, list[str]]:
    """Name and options of a label, as `Arm.parse` reads them."""
    words = label.split(":")
    name = ":".join(word for word in words if "=" not in word)
    return name, [word for word in words if "=" in word]
