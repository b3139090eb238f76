"""Adapters use underscored names of other packages only where a framework leaves no choice."""

from __future__ import annotations

import ast
from pathlib import Path

import fide_adapters

FOLDER = Path(fide_adapters.__file__).parent
UNAVOIDABLE = {
    "optuna/storage.py": {"_get_trials", "_storage", "_study_id", "_trial_id"},
    "nevergrad/optimizer.py": {"_meta"},
}


def private_names(path: Path) -> set[str]:
    """Underscored attributes of anything but `self`; named tuples have a public `_replace`."""
    attributes = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Attribute)]
    return {
        node.attr
        for node in attributes
        if node.attr.startswith("_") and not node.attr.startswith("__")
        if node.attr != "_replace"
        if not (isinstance(node.value, ast.Name) and node.value.id == "self")
    }


def test_private_names_are_where_the_comments_say_why() -> None:
    found = {str(p.relative_to(FOLDER)): private_names(p) for p in FOLDER.rglob("*.py")}
    assert {path: names for path, names in found.items() if names} == UNAVOIDABLE
