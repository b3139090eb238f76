"""Docstrings say "name, other: meaning", a line each; on the site these are lists of definitions.

A meaning may go on in further lines, which are indented.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

_FIELD = re.compile(r"^(\*{0,2}[a-z_]\w*(?:, \*{0,2}[a-z_]\w*)*(?:\(.*?\))?): (\S.*)$")


def setup(app: Any) -> dict[str, Any]:
    """Register the hook with Sphinx."""
    app.connect("autodoc-process-docstring", _process, priority=400)  # before Napoleon
    return {"parallel_read_safe": True}


def _process(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    lines[:] = [line for paragraph in _paragraphs(lines) for line in _as_list(paragraph)]


def _paragraphs(lines: list[str]) -> Iterator[list[str]]:
    """Blocks of lines, each with the empty lines after it."""
    block: list[str] = []
    for line in lines:
        if line and block and not block[-1]:
            yield block
            block = []
        block.append(line)
    yield block


def _as_list(paragraph: list[str]) -> Iterator[str]:
    """The paragraph itself, or a list of definitions if it begins with a field."""
    if not _FIELD.match(paragraph[0]) or not _is_list(paragraph):
        yield from paragraph
        return
    for line in paragraph:
        # "a: of it.  b, c: of them." are two fields in one line
        for part in re.split(r"(?<=\.)  (?=[a-z_]\w*(?:, [a-z_]\w*)*: )", line):
            found = _FIELD.match(part.strip()) if part == line or not line.startswith(" ") else None
            if found is None:
                yield f"    {part.strip()}" if part.strip() else ""
            else:
                names = ", ".join(f"``{one}``" for one in found[1].split(", "))
                yield names
                yield f"    {found[2]}"


def _is_list(paragraph: list[str]) -> bool:
    """Whether every line is a field, or the indented rest of one."""
    return all(not one or one.startswith("    ") or _FIELD.match(one) for one in paragraph)
