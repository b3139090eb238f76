"""A report as a document: one HTML page that needs nothing else.

Jinja2 escapes all text from files and names.
"""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

from fide_lab.report.tables import Strong, Table
from fide_plugins.errors import OptionError
from fide_plugins.runtime import files
from fide_plugins.runtime.machine import missing


class Picture(NamedTuple):
    """A picture; alt: its description."""

    alt: str
    png: bytes

    @property
    def address(self) -> str:
        """Data URL."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode()


@dataclass(frozen=True)
class Section:
    """A section; details: name and text of what is folded away."""

    title: str
    paragraphs: Sequence[str] = ()
    pictures: Sequence[Picture] = ()
    tables: Sequence[Table] = ()
    details: Sequence[tuple[str, str]] = ()


@dataclass(frozen=True)
class Document:
    """A report.

    summary: paragraphs; calls: command lines; method: how to read it; origin: what made it.
    """

    title: str
    summary: Sequence[str]
    calls: Sequence[str]
    sections: Sequence[Section]
    method: Sequence[str]
    origin: Mapping[str, Any]

    def write(self, path: Path) -> None:
        """Write the page; raises DependencyError (an ImportError) without Jinja2."""
        try:
            import jinja2
        except ImportError as error:
            raise missing("report", "a report needs Jinja2") from error
        from markupsafe import Markup

        folder = resources.files("fide_lab.report") / "templates"
        env = jinja2.Environment(
            autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
        )
        page = env.from_string((folder / "page.html").read_text("utf-8"))
        style = Markup((folder / "page.css").read_text("utf-8"))
        path.parent.mkdir(parents=True, exist_ok=True)
        files.write_text(
            path, page.render(d=self, style=style, is_strong=lambda t: isinstance(t, Strong))
        )


@dataclass(frozen=True)
class Written:
    """The page that was written; overview: what it says in short, for a terminal."""

    page: Path
    overview: str


def page_path(page: str | os.PathLike[str]) -> Path:
    """Path of a page; OptionError (a ValueError) without the suffix .html."""
    path = Path(page)
    if path.suffix.lower() not in (".html", ".htm"):
        raise OptionError(f"the page must be a file NAME.html, not {path.name!r}")
    return path


def companion(page: Path, name: str) -> Path:
    """Path of the file `name` of the report `page`: reports in one folder do not share files."""
    return page.with_name(name if page.stem == "report" else f"{page.stem}-{name}")
