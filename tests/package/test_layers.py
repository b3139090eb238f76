"""Packages and modules of `fide_plugins` import each other in one direction, without cycles."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from importlib.util import find_spec, resolve_name
from pathlib import Path

LAYERS = (
    ("errors", "status", "types"),
    ("runtime",),
    ("validation",),
    ("options", "population", "space"),
    ("denoiser", "renderers", "search"),
    ("learning", "uncertainty"),
    ("encoders",),
    ("losses", "proposers"),
    ("saving", "views"),
    ("baselines", "evaluation"),
    ("optimizers", "state"),
    ("preview", "readings", "recording"),
    ("retargeting",),
    ("asking",),
    ("fide",),
    ("distributed", "fitting"),
    ("experiments", "watch"),
    ("cli",),
    ("__main__",),
)
"""Each imports from rows above its own only, also in functions; what is for types only is free."""

EXCEPTIONS = {
    ("learning", "fitting"): "renders for a model are made by the workers of `fit`",
    ("baselines.__init__", "optimizers"): "it has the names; it loads a baseline that is used",
}
"""What else a package or module imports, and why that is a reasonable cycle."""

ROW = {name: row for row, names in enumerate(LAYERS) for name in names}


def imports(source: str, module: str) -> Iterator[str]:
    """What a module imports of `fide_plugins`, by the first part of its name; not for types only.

    module: its name without "fide_plugins.", such as "space.kinds" or "space.__init__".
    """
    package = f"fide_plugins.{module}".rpartition(".")[0]
    for node in _imports(ast.parse(source)):
        if isinstance(node, ast.Import):
            found = [one.name for one in node.names]
        else:
            base = resolve_name("." * node.level + (node.module or ""), package)
            found = [f"{base}.{one.name}" for one in node.names]
        for parts in (name.split(".") for name in found):
            if parts[0] == "fide_plugins" and len(parts) > 1:
                yield parts[1]


def _imports(node: ast.AST) -> Iterator[ast.Import | ast.ImportFrom]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import | ast.ImportFrom):
            yield child
        elif not (isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING"):
            yield from _imports(child)


def modules() -> Iterator[tuple[str, str]]:
    """Name and source of every module, but for the package itself, which loads all on demand."""
    spec = find_spec("fide_plugins")
    assert spec is not None and spec.origin is not None
    root = Path(spec.origin).parent
    for path in sorted(root.rglob("*.py")):
        name = ".".join(path.relative_to(root).with_suffix("").parts)
        if name != "__init__":
            yield name, path.read_text("utf-8")


def upward() -> Iterator[tuple[str, str]]:
    """Module, and what it imports, for each import that is not from a row above."""
    for module, source in modules():
        own = module.split(".")[0]
        for other in sorted(set(imports(source, module)) - {own, "__version__"}):
            if ROW.get(other, len(LAYERS)) >= ROW[own]:
                yield module, other


def exceptions(module: str, other: str) -> set[tuple[str, str]]:
    """Those of the exceptions that allow a module to import the other."""
    return {
        (where, allowed)
        for where, allowed in EXCEPTIONS
        if allowed == other and f"{module}.".startswith(f"{where}.")
    }


def test_imports_are_found() -> None:
    source = """
from __future__ import annotations
import numpy, fide_plugins.space.kinds
from fide_plugins import losses as losses_module, __version__
from ..runtime import files
from .views import View
if TYPE_CHECKING:
    from fide_plugins.fide import FIDE
def f():
    from fide_plugins.search.one_search import Search
"""
    found = list(imports(source, "views.__init__"))
    assert found == ["space", "losses", "__version__", "runtime", "views", "search"]


def test_every_package_has_its_row() -> None:
    assert {module.split(".")[0] for module, _ in modules()} == set(ROW)


def test_imports_are_from_the_rows_above() -> None:
    found = [f"{module} -> {other}" for module, other in upward() if not exceptions(module, other)]
    assert not found, f"move what both need, or the rows: {', '.join(found)}"


def test_every_exception_is_needed() -> None:
    assert set.union(*(exceptions(module, other) for module, other in upward())) == set(EXCEPTIONS)
