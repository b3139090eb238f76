"""The checks of the site find what they are for; docstrings become lists as they should."""

from __future__ import annotations

import re
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


def load(name: str) -> ModuleType:
    spec = spec_from_file_location(Path(name).stem, DOCS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look themselves up
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def check_site() -> ModuleType:
    return load("check_site")


def site(folder: Path, **pages: str) -> Path:
    for name, text in pages.items():
        path = folder / f"{name.replace('__', '/')}.html"
        path.parent.mkdir(exist_ok=True)
        path.write_text(f"<html><body><article>{text}</article></body></html>", "utf-8")
    return folder.resolve()


def test_a_link_to_no_file_or_no_place_is_broken(check_site: ModuleType, tmp_path: Path) -> None:
    there = '<a href="other.html#here">x</a> <a href="#top">x</a> <a href="https://x.org/a">x</a>'
    folder = site(tmp_path, index=f'<p id="top">{there}</p>', other='<p id="here">x</p>')
    assert check_site.broken(check_site.read(folder)) == []
    site(tmp_path, index='<a href="none.html">x</a> <a href="other.html#there">x</a>')
    first, second = check_site.broken(check_site.read(folder))
    assert "none.html leads to no file" in first and "other.html#there leads to no place" in second


def test_nothing_is_loaded_from_elsewhere(check_site: ModuleType, tmp_path: Path) -> None:
    folder = site(tmp_path, index='<script src="https://cdn.example/x.js"></script>')
    (wrong,) = check_site.broken(check_site.read(folder))
    assert "loads https://cdn.example/x.js from elsewhere" in wrong
    site(tmp_path, index='<link rel="stylesheet" href="//cdn.example/x.css">')
    assert len(check_site.broken(check_site.read(folder))) == 1


def test_docstrings_of_public_names_say_parameters_and_errors() -> None:
    names = load("extensions/public_names")
    assert len(list(names.public())) > 100
    assert list(names.gaps()) == []


REPORTS = sorted((ROOT / "lab" / "reports").glob("*.md"))


@pytest.mark.parametrize("page", REPORTS, ids=lambda p: p.stem)
def test_a_report_begins_with_its_answer(page: Path) -> None:
    _, answer, *_ = page.read_text("utf-8").split("\n\n")
    assert not answer.startswith(("    ", "|", "#", "```", "![")) and len(answer.split()) <= 65


def places(page: Path) -> set[str]:
    """Anchors of the headings of a page, as a repository's website makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", one.lower()).replace(" ", "-") for one in headings}


@pytest.mark.parametrize("page", REPORTS, ids=lambda p: p.stem)
def test_links_of_a_report_lead_somewhere(page: Path) -> None:
    """`make docs` checks those of the guide."""
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text("utf-8")):
        path, _, place = link.partition("#")
        if "://" not in link:
            goal = page if not path else (page.parent / path)
            assert goal.exists(), link
            assert not place or goal.suffix != ".md" or place in places(goal), link


@pytest.mark.skipif(not (DOCS.parent / "lab/fide_lab").exists(), reason="the sources are not here")
def test_the_picture_of_the_rooms_is_of_the_present_code() -> None:
    rooms = load("rooms")
    assert rooms.PICTURE.read_text("utf-8") == rooms.svg(), "run: python docs/rooms.py"


def test_the_guide_is_short() -> None:
    pages = [*DOCS.rglob("*.md"), *DOCS.rglob("*.rst")]
    words = sum(len(page.read_text("utf-8").split()) for page in pages)
    assert words <= 40_000
