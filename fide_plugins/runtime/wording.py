"""Words of messages."""

from __future__ import annotations

__all__ = ["counted"]


def counted(number: int, thing: str) -> str:
    """A number of things, in the plural unless it is one.

    >>> counted(1, "problem"), counted(2000, "problem")
    ('1 problem', '2000 problems')
    """
    return f"{number} {thing}{'s' * (number != 1)}"
