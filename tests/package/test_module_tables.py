"""Where the docstring of a package has a table of its modules, the table has all of them."""

from __future__ import annotations

import ast
import re
from fnmatch import fnmatchcase
from importlib.util import find_spec
from pathlib import Path

import pytest


def table(init: Path) -> list[str]:
    """First column of the table in the docstring of an ``__init__.py``; empty without a table."""
    docstring = ast.get_docstring(ast.parse(init.read_text("utf-8"))) or ""
    lines = docstring.splitlines()
    bars = [i for i, line in enumerate(lines) if re.fullmatch(r"=+ +=+", line)]
    rows = lines[bars[0] : bars[-1]] if bars else []
    return [match[1] for row in rows if (match := re.match(r"`(\w+)/?`", row))]


def modules(folder: Path) -> list[str]:
    """Modules and packages of a folder; what else is in it is data."""
    files = [file.stem for file in folder.glob("*.py") if file.stem != "__init__"]
    return sorted([*files, *(file.parent.name for file in folder.glob("*/__init__.py"))])


def differences(folder: Path) -> list[str]:
    """What the table of a package lacks, and what it has although it is not there."""
    here, names = modules(folder), table(folder / "__init__.py")
    patterns = [name.replace("NAME", "*") for name in names]  # one row for several modules
    lacks = [f"lacks {one}" for one in here if not any(fnmatchcase(one, p) for p in patterns)]
    known = [*here, *(path.name for path in folder.iterdir() if path.is_dir())]
    gone = [p for p in patterns if not any(fnmatchcase(one, p) for one in known)]
    return lacks + [f"has {one}, which is gone" for one in gone]


def packages() -> list[Path]:
    """Folders of all packages whose docstring has a table of modules."""
    found = []
    for name in ("fide_plugins", "fide_adapters", "fide_lab", "fide_tasks"):
        spec = find_spec(name)
        assert spec is not None and spec.origin is not None
        found += [init.parent for init in Path(spec.origin).parent.rglob("__init__.py")]
    return sorted(folder for folder in found if table(folder / "__init__.py"))


@pytest.mark.parametrize("folder", packages(), ids=lambda folder: "/".join(folder.parts[-2:]))
def test_the_table_of_a_package_has_its_modules(folder: Path) -> None:
    assert not differences(folder)
