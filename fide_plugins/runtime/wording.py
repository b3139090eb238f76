"""Words of messages."""

from __future__ import annotations

__all__ = ["counted", "cut"]


def counted(number: int, thing: str) -> str:
    """A number of things, in the plural unless it is one.

    >>> counted(1, "problem"), counted(2000, "problem")
    ('1 problem', '2000 problems')
    """
    return f"{number} {thing}{'s' * (number != 1)}"


def cut(text: str, most: int) -> str:
    """One line of text of at most so many characters, with both ends of a longer one.

    >>> cut("left_shoulder_rotation", 12), cut("short", 12)
    ('left_...tion', 'short')
    """
    text = " ".join(text.split())
    if len(text) <= most:
        return text
    end = (most - 3) // 2
    return f"{text[: most - 3 - end]}...{text[len(text) - end :]}"
