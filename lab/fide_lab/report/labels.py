"""Short names of configurations for figures and tables.

>>> short_names(["cma", "cma:popsize=50", "dibo:batch=64:budget=600"])
{'cma': 'cma', 'cma:popsize=50': 'cma:popsize=50', 'dibo:batch=64:budget=600': 'dibo'}
"""

from __future__ import annotations

from collections.abc import Iterable

from fide_lab.compare.plan import split

__all__ = ["fitted", "short_names"]


def short_names(labels: Iterable[str]) -> dict[str, str]:
    """Short name of each label: without the options that all labels of an optimizer share.

    Different labels keep different names, since labels of one optimizer differ in some option.
    """
    words = {label: split(label) for label in labels}
    shared: dict[str, set[str]] = {}
    for name, options in words.values():
        shared[name] = shared.get(name, set(options)) & set(options)
    return {
        label: ":".join([name, *(option for option in options if option not in shared[name])])
        for label, (name, options) in words.items()
    }


def fitted(text: str, room: int) -> str:
    """`text`, cut to at most `room` characters.

    >>> fitted("fide-annealing:budget=2000", 12)
    'fide-anneal…'
    """
    return text if len(text) <= room else text[: room - 1] + "…"
