"""What the docstrings of this project look like on the site.

Two forms of lists are made lists of definitions: the sections of NumPy's style, and "name, other:
meaning", a line each, where a meaning may go on in further lines, which are indented.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

_NAMES = r"\*{0,2}[a-zA-Z_][\w.]*(?:, \*{0,2}[a-zA-Z_][\w.]*)*"
_FIELD = re.compile(rf"^({_NAMES}):(?: (\S.*))?$")
_SECOND = re.compile(rf"(?<=[.)])  (?={_NAMES}: )")
_SECTIONS = ("Parameters", "Raises", "Returns", "Yields", "Attributes")


def setup(app: Any) -> dict[str, Any]:
    """Register the hook with Sphinx."""
    app.connect("autodoc-process-docstring", _process)
    return {"parallel_read_safe": True}


def _process(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    lines[:] = [line for block in _blocks(list(_rubrics(lines))) for line in _as_list(block)]


def _rubrics(lines: list[str]) -> Iterator[str]:
    """Sections of NumPy's style: a small heading, and terms in the type of code."""
    i, section = 0, ""
    while i < len(lines):
        following = lines[i + 1] if i + 1 < len(lines) else ""
        if lines[i] in _SECTIONS and set(following) == {"-"}:
            section = lines[i]
            yield from (f".. rubric:: {section}", "")
            i += 2
            continue
        if section and re.fullmatch(_NAMES, lines[i]) and following.startswith("    "):
            yield _terms(lines[i], code=section != "Raises")
        else:
            yield lines[i]
        i += 1


def _blocks(lines: list[str]) -> Iterator[list[str]]:
    """Paragraphs, each with the empty lines after it."""
    block: list[str] = []
    for line in lines:
        if line and block and not block[-1]:
            yield block
            block = []
        block.append(line)
    yield block


def _as_list(block: list[str]) -> Iterator[str]:
    """The block itself, or a list of definitions if each line is a field or the rest of one."""
    is_list = all(not one or one.startswith("    ") or _FIELD.match(one) for one in block)
    if not is_list or not _FIELD.match(block[0]):
        yield from block
        return
    for line in block:
        for part in _SECOND.split(line) if not line.startswith(" ") else [line]:
            found = _FIELD.match(part)
            if found:
                yield _terms(found[1], code=True)
                if found[2]:
                    yield f"    {found[2]}"
            else:
                yield f"    {part.strip()}" if part.strip() else ""


def _terms(names: str, *, code: bool) -> str:
    """Names separated by commas, as code or as links to what they name."""
    mark = "``" if code else "`"
    return ", ".join(f"{mark}{name}{mark}" for name in names.split(", "))
