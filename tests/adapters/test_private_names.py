"""Adapters use underscored names of other packages only where a framework leaves no choice."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from nevergrad.optimization.base import Optimizer

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


def test_the_docstring_names_what_is_inherited_from_nevergrad() -> None:
    """Underscored names of its optimizers: called, read, set in a dump, or overridden."""
    made = Optimizer(parametrization=2)
    source = (FOLDER / "nevergrad/optimizer.py").read_text()
    docstring = ast.get_docstring(ast.parse(source), clean=False) or ""
    used = set(re.findall(r"\b_[a-z]\w*", source.replace(docstring, "")))
    named = set(re.findall(r"`(_[a-z]\w*)`", docstring))
    assert used & {*dir(made), *vars(made)} == named - {"_meta"}
