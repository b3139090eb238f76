"""The checks of the site find what they are for; docstrings become lists as they should."""

from __future__ import annotations

import re
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from PIL import Image

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


class TestBrowser:
    """The check in a browser complains of what is wrong, and only of that."""

    FILM = '<img src="film.webp" width="40" height="40">'
    FOUND = '<div id="search-results"><p class="search-summary">x</p></div>'

    @pytest.fixture
    def check(self) -> ModuleType:
        return load("check_browser")

    @pytest.fixture
    def good(self, tmp_path: Path) -> Path:
        """A site of one page that follows the scheme, with a picture of two frames."""
        frames = [Image.new("RGB", (40, 40), color) for color in ("red", "blue")]
        for name, some in (("film", frames), ("still", frames[:1])):
            more: dict[str, Any] = {
                "save_all": True,
                "append_images": some[1:],
                "duration": 100,
                "loop": 0,
            }
            some[0].save(tmp_path / f"{name}.webp", **more)
        style = "<style>:root { color-scheme: light dark; } img { max-width: 100% }</style>"
        body = (
            "<style>body { background: #fff; color: #000 }"
            "@media (prefers-color-scheme: dark) { body { background: #000; color: #fff } }</style>"
        )
        return site(
            tmp_path, index=f"{style}{body}<p>words</p>{self.FILM}", gallery=body + self.FILM
        )

    def add(self, folder: Path, text: str) -> None:
        page = folder / "index.html"
        page.write_text(page.read_text("utf-8").replace("</article>", f"{text}</article>"), "utf-8")

    def read(self, check: ModuleType, browser: Any, folder: Path) -> list[str]:
        schemes = (("light", check.SCREEN), ("dark", check.PHONE))
        return [one for how in schemes for one in check.read(browser, folder, *how)]

    @pytest.mark.thorough
    def test_a_good_site(self, check: ModuleType, browser: Any, good: Path) -> None:
        assert self.read(check, browser, good) == []
        assert list(check.films(browser, good)) == []

    @pytest.mark.parametrize(
        ("text", "complaint"),
        [
            ('<div style="width: 500px">x</div>', "index.html (dark, 390 px): 508 px wide"),
            ('<img src="none.png">', "the picture none.png does not load"),
            ("<script>throw new Error('oh')</script>", "index.html (light, 1280 px): oh"),
            ("<style>p { color: #888 }</style>", "contrast of text 3.5, less than 4.5"),
            ("<style>body { background: #fff !important; color: #000 !important }</style>",
             "index.html (dark, 390 px): the background is light"),
        ],
    )  # fmt: skip
    def test_what_is_wrong(
        self, check: ModuleType, browser: Any, good: Path, text: str, complaint: str
    ) -> None:
        self.add(good, text)
        assert any(complaint in one for one in self.read(check, browser, good))

    def test_a_search_that_finds_nothing(self, check: ModuleType, browser: Any, good: Path) -> None:
        form = f'<form action="index.html"><input name="q"></form>{self.FOUND}'
        self.add(good, form)
        searches = {"noise": "howto/noise.html"}
        (trouble,) = check.searched(browser, good, searches, wait=500)
        assert trouble == "the search for 'noise' does not find howto/noise.html"
        self.add(good, '<div id="search-results"><a href="howto/noise.html">x</a></div>')
        assert list(check.searched(browser, good, searches)) == []
