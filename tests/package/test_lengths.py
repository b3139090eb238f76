"""Functions stay under 50 lines, docstrings not counted."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

LIMIT = 50


def lengths(source: str) -> Iterator[tuple[str, int]]:
    """Name and lines of each function, from its `def` to its end, but for its docstring."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            has_docstring = ast.get_docstring(node) is not None
            yield node.name, _lines(node) - (_lines(node.body[0]) if has_docstring else 0)


def _lines(node: ast.stmt) -> int:
    assert node.end_lineno is not None
    return node.end_lineno - node.lineno + 1


@pytest.mark.parametrize("package", ["fide_plugins", "fide_adapters", "fide_lab", "fide_tasks"])
def test_functions_stay_under_the_limit(package: str) -> None:
    spec = find_spec(package)
    assert spec is not None and spec.origin is not None
    root = Path(spec.origin).parent
    found = []
    for path in sorted(root.rglob("*.py")):
        source = path.read_text("utf-8")
        counts = {f": {name}": lines for name, lines in lengths(source) if lines >= LIMIT}
        found += [f"{path.relative_to(root)}{name} has {n} lines" for name, n in counts.items()]
    assert not found, "\n".join(found)
