"""Check the site that `make docs` built, as a reader without a network meets it.

    python docs/check_site.py build/docs/html

Every link within the site leads somewhere, anchors included; no page loads anything from elsewhere;
every page is at most two clicks from the front page; a notebook shows pictures; the
site is at most 30 MB.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LARGEST = 30e6  # bytes
MACHINERY = ("genindex.html", "search.html", "_static/")
_LOADED = {("script", "src"), ("img", "src"), ("iframe", "src"), ("source", "src")}


@dataclass
class Page(HTMLParser):
    """What one page links to and loads, and the anchors in it."""

    links: list[str] = field(default_factory=list)
    text_links: list[str] = field(default_factory=list)  # in the page itself, not beside it
    loaded: list[str] = field(default_factory=list)
    anchors: set[str] = field(default_factory=set)
    in_text: int = 0
    is_notebook: bool = False

    def __post_init__(self) -> None:
        super().__init__(convert_charrefs=True)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note the links, sources and anchors of a tag."""
        given = {name: value for name, value in attrs if value is not None}
        self.anchors.update(given[name] for name in ("id", "name") if name in given)
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
            if self.in_text:
                self.text_links.append(given["href"])
        if tag == "article":
            self.in_text += 1
        self.is_notebook |= "cell_input" in given.get("class", "").split()
        self.loaded += [value for name, value in given.items() if (tag, name) in _LOADED]
        if tag == "link" and given.get("rel") in ("stylesheet", "icon", "preload"):
            self.loaded.append(given.get("href", ""))

    def handle_endtag(self, tag: str) -> None:
        """Note where the text of the page ends."""
        if tag == "article":
            self.in_text -= 1


def read(site: Path) -> dict[Path, Page]:
    """All pages of the site, by their files."""
    pages = {}
    for file in sorted(site.rglob("*.html")):
        pages[file] = page = Page()
        page.feed(file.read_text("utf-8"))
    return pages


def goal(file: Path, link: str) -> tuple[Path, str] | None:
    """File and anchor of a link; None if it leads out of the site."""
    parts = urlsplit(link)
    if parts.scheme or parts.netloc:
        return None
    target = (file.parent / unquote(parts.path)).resolve() if parts.path else file
    return target, unquote(parts.fragment)


def broken(pages: dict[Path, Page]) -> list[str]:
    """Links and sources that lead nowhere, and sources that need a network."""
    found = []
    for file, page in pages.items():
        for link in (*page.links, *page.loaded):
            where = goal(file, link)
            if where is None:
                if link in page.loaded and not link.startswith("data:"):
                    found.append(f"{file}: loads {link} from elsewhere")
                continue
            target, anchor = where
            if not target.is_file():
                found.append(f"{file}: {link} leads to no file")
            elif anchor and target in pages and anchor not in pages[target].anchors:
                found.append(f"{file}: {link} leads to no place in {target.name}")
    return found


def distant(pages: dict[Path, Page], site: Path, clicks: int = 2) -> list[str]:
    """Pages that are more clicks from the front page, without the bar beside it."""
    reached = {site / "index.html"}
    for _ in range(clicks):
        links = [
            (file, link) for file in reached if file in pages for link in pages[file].text_links
        ]
        reached |= {where[0] for where in (goal(*one) for one in links) if where}
    names = {file: file.relative_to(site).as_posix() for file in pages}
    far = [file for file in pages if file not in reached and not names[file].startswith(MACHINERY)]
    return [f"{file}: more than {clicks} clicks away" for file in far]


def without_pictures(pages: dict[Path, Page]) -> list[str]:
    """Notebooks whose cells have left no picture on the page."""
    cells = [file for file, page in pages.items() if page.is_notebook]
    shown = [f for f in cells if any("_images/" in source for source in pages[f].loaded)]
    return [f"{file}: a notebook without a picture" for file in cells if file not in shown]


def main() -> int:
    """Print what is wrong; 1 if anything is."""
    site = Path(sys.argv[1]).resolve()
    pages = read(site)
    size = sum(file.stat().st_size for file in site.rglob("*") if file.is_file())
    wrong = broken(pages) + distant(pages, site) + without_pictures(pages)
    if size > LARGEST:
        wrong.append(f"{site}: {size / 1e6:.0f} MB, more than {LARGEST / 1e6:.0f}")
    print("\n".join(wrong) or f"{len(pages)} pages, {size / 1e6:.1f} MB, no broken link")
    return 1 if wrong or not pages else 0


if __name__ == "__main__":
    sys.exit(main())
