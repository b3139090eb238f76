"""Packages and modules import each other in one direction, without cycles."""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from importlib.util import find_spec, resolve_name
from pathlib import Path

import pytest

LAYERS = (
    ("errors", "status", "types"),
    ("runtime",),
    ("baselines", "experiments", "optimizers", "watch"),  # old names of modules of `fide_lab`
    ("validation",),
    ("encoders", "options", "population", "space"),
    ("denoiser", "renderers", "search"),
    ("learning", "uncertainty"),
    ("losses", "proposers"),
    ("saving", "views"),
    ("comparison",),
    ("evaluation",),
    ("adapt_comparison", "state"),
    ("recording",),
    ("fide",),
    ("fitting",),
    ("cli",),
    ("__main__",),
)
"""Each imports from rows above its own only, also in functions; what is for types only is free."""

EXCEPTIONS = {
    ("learning", "fitting"): "renders for a model are made by the workers of `fit`",
}
"""What else a package or module imports, and why that is a reasonable cycle."""

ROW = {name: row for row, names in enumerate(LAYERS) for name in names}


def imports(source: str, module: str, root: str = "fide_plugins") -> Iterator[str]:
    """What a module imports of its own root, such as "space.kinds.Int"; not for types only.

    module: its name without the root, such as "space.kinds" or "space.__init__".
    """
    package = f"{root}.{module}".rpartition(".")[0]
    for node in _imports(ast.parse(source)):
        if isinstance(node, ast.Import):
            found = [one.name for one in node.names]
        else:
            base = resolve_name("." * node.level + (node.module or ""), package)
            found = [f"{base}.{one.name}" for one in node.names]
        yield from (name.removeprefix(f"{root}.") for name in found if name.startswith(f"{root}."))


def _imports(node: ast.AST) -> Iterator[ast.Import | ast.ImportFrom]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import | ast.ImportFrom):
            yield child
        elif not (isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING"):
            yield from _imports(child)


def modules(root: str = "fide_plugins") -> Iterator[tuple[str, str]]:
    """Name and source of every module, but for the root itself, which loads all on demand."""
    spec = find_spec(root)
    assert spec is not None and spec.origin is not None
    folder = Path(spec.origin).parent
    for path in sorted(folder.rglob("*.py")):
        name = ".".join(path.relative_to(folder).with_suffix("").parts)
        if name != "__init__":
            yield name, path.read_text("utf-8")


def upward() -> Iterator[tuple[str, str]]:
    """Module, and what it imports, for each import that is not from a row above."""
    for module, source in modules():
        own = module.split(".")[0]
        others = {name.split(".")[0] for name in imports(source, module)}
        for other in sorted(others - {own, "__version__"}):
            if ROW.get(other, len(LAYERS)) >= ROW[own]:
                yield module, other


def exceptions(module: str, other: str) -> set[tuple[str, str]]:
    """Those of the exceptions that allow a module to import the other."""
    return {
        (where, allowed)
        for where, allowed in EXCEPTIONS
        if allowed == other and f"{module}.".startswith(f"{where}.")
    }


def loaded(name: str, module: str, known: Collection[str]) -> Iterator[str]:
    """Modules that `module` loads by importing `name`: what it names, and packages around that.

    Packages that the importing module lies in are loaded already, unless they are what is named.
    """
    parts = name.split(".")
    prefixes = [".".join(parts[:n]) for n in range(len(parts), 0, -1)]
    found = [one for prefix in prefixes for one in (prefix, f"{prefix}.__init__") if one in known]
    yield from found[:1]
    yield from (one for one in found[1:] if not module.startswith(one.removesuffix("__init__")))


def graph(root: str) -> dict[str, set[str]]:
    """What each module imports, also inside functions, but for the exceptions."""
    sources = dict(modules(root))
    return {
        module: {
            other
            for name in imports(source, module, root)
            for other in loaded(name, module, sources)
            if (module, other) not in EXCEPTIONS
        }
        for module, source in sources.items()
    }


def cycle(graph: Mapping[str, Collection[str]]) -> list[str]:
    """Modules of a cycle, from one to itself; empty if there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        found: list[str] = error.args[1]
        return found
    return []


def test_every_package_has_its_row() -> None:
    assert {module.split(".")[0] for module, _ in modules()} == set(ROW)


def test_imports_are_from_the_rows_above() -> None:
    found = [f"{module} -> {other}" for module, other in upward() if not exceptions(module, other)]
    assert not found, f"move what both need, or the rows: {', '.join(found)}"


@pytest.mark.parametrize("root", ["fide_plugins", "fide_adapters", "fide_tasks"])
def test_only_the_laboratory_imports_from_the_laboratory(root: str) -> None:
    """`fide_plugins.runtime.laboratory` finds it by name."""
    for name, source in modules(root):
        for node in _imports(ast.parse(source)):
            named = [getattr(node, "module", None) or "", *(one.name for one in node.names)]
            assert not any(one.split(".")[0] == "fide_lab" for one in named), name


def test_every_exception_is_needed() -> None:
    assert set.union(*(exceptions(module, other) for module, other in upward())) == set(EXCEPTIONS)


@pytest.mark.parametrize("root", ["fide_plugins", "fide_adapters", "fide_lab", "fide_tasks"])
def test_modules_import_each_other_in_one_direction(root: str) -> None:
    found = cycle(graph(root))
    assert not found, f"move what both need: {' -> '.join(reversed(found))}"
