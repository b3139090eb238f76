"""What is private to an optimizer and to its state is used by nobody else."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
OWNERS = {"FIDE": ROOT / "fide_plugins" / "fide.py", "State": ROOT / "fide_plugins" / "state.py"}
FOLDERS = ("fide_plugins", "adapters", "lab", "tasks", "examples", "benchmarks")
if not OWNERS["FIDE"].exists():  # the tests of the installed package
    pytest.skip("the sources are not here", allow_module_level=True)


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.endswith("__")


def private_names(source: str, owner: str) -> set[str]:
    """Private methods and attributes of a class."""
    [body] = [
        node
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.ClassDef) and node.name == owner
    ]
    names = set()
    for node in ast.walk(body):
        if isinstance(node, ast.FunctionDef):
            names.add(node.name)
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names.add(node.target.id)  # a field of a dataclass
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            names.add(node.attr)
    return {name for name in names if is_private(name)}


def accesses(source: str, names: set[str]) -> Iterator[tuple[int, str]]:
    """Line and text of each access to one of the names, but on `self` or `cls`."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Attribute) or node.attr not in names:
            continue
        if not (isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")):
            yield node.lineno, ast.unparse(node)


PRIVATE = set.union(
    *(private_names(path.read_text("utf-8"), name) for name, path in OWNERS.items())
)


@pytest.mark.parametrize("folder", FOLDERS)
def test_nobody_uses_what_is_private_to_an_optimizer_or_its_state(folder: str) -> None:
    paths = [path for path in (ROOT / folder).rglob("*.py") if path not in OWNERS.values()]
    assert paths
    found = [
        f"{path.relative_to(ROOT)}:{line}: {text}"
        for path in paths
        for line, text in accesses(path.read_text("utf-8"), PRIVATE)
    ]
    assert not found, "\n".join(found)
