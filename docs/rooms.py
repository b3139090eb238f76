"""Draws the rooms of the code for ARCHITECTURE.md: each imports only from rows below its own.

    python docs/rooms.py            # writes docs/images/rooms.svg, which a test compares

A room is a subpackage, or a module beside them.  Its text is the first sentence of its docstring.
Rows follow from the imports: a room stands one row above the highest that it imports.  The one
cycle, between `learning` and `fitting`, is cut where `tests/package/test_layers.py` allows it.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from html import escape
from pathlib import Path
from textwrap import wrap

ROOT = Path(__file__).resolve().parent.parent
PICTURE = ROOT / "docs/images/rooms.svg"
CUT = {("learning", "fitting")}
OLD_NAMES = {"baselines", "experiments", "optimizers", "watch"}
WITHOUT = {"errors", "types", "__init__", "__main__"} | OLD_NAMES
WIDTH, HEIGHT, GAP, LETTERS = 250, 52, 8, 42  # of a room, in pixels; of a line of its text
TOPS = (
    ("adapters/fide_adapters", "fide_adapters"),
    ("lab/fide_lab", "fide_lab"),
    ("tasks/fide_tasks", "fide_tasks"),
)


def rooms() -> dict[str, tuple[str, set[str]]]:
    """Name: what it is, and which rooms it imports, also inside functions; not for types only."""
    folder = ROOT / "fide_plugins"
    paths = {p.name if p.is_dir() else p.stem: p for p in sorted(folder.iterdir())}
    paths = {n: p for n, p in paths.items() if p.suffix == ".py" or (p / "__init__.py").exists()}
    names = set(paths) - WITHOUT
    found = {}
    for name in sorted(names):
        files = sorted(paths[name].rglob("*.py")) if paths[name].is_dir() else [paths[name]]
        imported = {room for file in files for room in _imports(ast.parse(file.read_text("utf-8")))}
        cut = {other for one, other in CUT if one == name}
        found[name] = (_idea(paths[name]), (imported & names) - {name} - cut)
    return found


def _imports(node: ast.AST) -> Iterator[str]:
    """Rooms of `fide_plugins` that a piece of code imports."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ImportFrom) and child.module and child.level == 0:
            parts = child.module.split(".")
            if parts[0] == "fide_plugins":
                yield from parts[1:2] or [alias.name for alias in child.names]
        elif not (isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING"):
            yield from _imports(child)


def _idea(path: Path) -> str:
    """First sentence of the docstring of a module or package."""
    source = (path / "__init__.py" if path.is_dir() else path).read_text("utf-8")
    text = " ".join((ast.get_docstring(ast.parse(source)) or "").split("\n\n")[0].split())
    return text.split(". ")[0].split(": ")[-1].rstrip(".").replace("`", "")


def rows(found: dict[str, tuple[str, set[str]]]) -> list[list[str]]:
    """Names of each row, the lowest first."""
    row: dict[str, int] = {}

    def place(name: str) -> int:
        if name not in row:
            row[name] = 1 + max((place(other) for other in found[name][1]), default=-1)
        return row[name]

    for name in found:
        place(name)
    return [sorted(n for n in found if row[n] == i) for i in range(max(row.values()) + 1)]


def svg() -> str:
    """The picture."""
    found = rooms()
    table = [
        [(name, found[name][0], "#e8f0fe") for name in names] for names in reversed(rows(found))
    ]
    others = [(name, _idea(ROOT / path), "#fef3e0") for path, name in TOPS]
    table.insert(0, others)
    columns = max(len(row) for row in table)
    width = columns * (WIDTH + GAP) + GAP
    height = len(table) * (HEIGHT + GAP) + GAP
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}"'
        f' font-family="sans-serif" font-size="11">',
        f'<rect width="{width}" height="{height}" fill="white"/>',
    ]
    for i, row in enumerate(table):
        left = (width - len(row) * (WIDTH + GAP) + GAP) / 2
        for j, room in enumerate(row):
            parts += _box(left + j * (WIDTH + GAP), GAP + i * (HEIGHT + GAP), *room)
    return "\n".join([*parts, "</svg>", ""])


def _box(x: float, y: float, name: str, idea: str, color: str) -> Iterator[str]:
    yield (
        f'<rect x="{x:g}" y="{y:g}" width="{WIDTH}" height="{HEIGHT}" rx="6" fill="{color}"'
        f' stroke="#7a8699"/>'
    )
    yield f'<text x="{x + 8:g}" y="{y + 17:g}" font-size="13" font-weight="bold">{name}</text>'
    for i, line in enumerate(wrap(idea, LETTERS, max_lines=2, placeholder=" ...")):
        yield f'<text x="{x + 8:g}" y="{y + 32 + 12 * i:g}">{escape(line)}</text>'


def main() -> None:
    """Write the picture."""
    PICTURE.write_text(svg(), "utf-8")


if __name__ == "__main__":
    main()
