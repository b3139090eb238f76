"""Adapters use underscored names of other packages only where a framework leaves no choice."""

from __future__ import annotations

import ast
from pathlib import Path

import fide_adapters

FOLDER = Path(fide_adapters.__file__).parent
UNAVOIDABLE = {
    "optuna/sampler.py": {"_base_sampler"},
    "optuna/replica.py": {"_batches", "_taken"},
    "optuna/storage.py": {"_storage", "_study_id", "_trial_id"},
    "nevergrad/optimizer.py": {"_meta"},
    "nevergrad/parametrization.py": {"_value"},
}


def private_names(path: Path) -> set[str]:
    """Underscored attributes of anything but `self`; named tuples have a public `_replace`."""
    named = [attribute(node) for node in ast.walk(ast.parse(path.read_text()))]
    return {
        name
        for owner, name in filter(None, named)
        if name.startswith("_") and not name.startswith("__") and name != "_replace"
        if not (isinstance(owner, ast.Name) and owner.id == "self")
    }


def attribute(node: ast.AST) -> tuple[ast.expr, str] | None:
    """Owner and name of an attribute, written with a dot or as a text: `getattr(owner, "name")`."""
    match node:
        case ast.Attribute(value=owner, attr=name):
            return owner, name
        case ast.Call(
            func=ast.Name(id="getattr" | "hasattr" | "setattr" | "delattr"),
            args=[owner, ast.Constant(value=str(name)), *_],
        ):
            return owner, name
    return None


def test_an_attribute_in_a_text_is_found(tmp_path: Path) -> None:
    code = tmp_path / "code.py"
    code.write_text(
        'getattr(self, "_own"); getattr(study, "_a", None); study._b; self._c; x._replace()'
    )
    assert private_names(code) == {"_a", "_b"}


def test_private_names_are_where_the_comments_say_why() -> None:
    found = {str(p.relative_to(FOLDER)): private_names(p) for p in FOLDER.rglob("*.py")}
    assert {path: names for path, names in found.items() if names} == UNAVOIDABLE
