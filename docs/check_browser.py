"""Read the site that `make docs` built in a real browser, from its files, as a reader does.

    python docs/check_browser.py build/docs/html

On a phone and on a screen, in the light and in the dark: every page fits the width, its pictures
load, its text stands out from what is behind it, and nothing is complained of in the console.  The
search finds a page, and films play.  Without a browser it says so and ends well.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
PHONE = {"width": 390, "height": 844}  # pixels
SCREEN = {"width": 1280, "height": 900}
VIEWS = ("light", SCREEN), ("light", PHONE), ("dark", PHONE)
CONTRAST = 4.5  # of text and background at least, as WCAG 2 asks (level AA)
FILM_WAIT = 30_000  # ms until a film must have shown another frame; it changes ten times a second
SEARCH_WAIT = 60_000  # ms until a search must have shown its results
SEARCHES = {
    "noisy renderer": "howto/noise.html", "FIDESampler": "howto/optuna.html",
    "Mitsuba camera": "howto/mitsuba.html", "galaxies": "howto/astronomy.html",
}  # fmt: skip
"""Words that a reader may type, and a page that must be among the results."""

_EMPTY_PICTURES = """async () => {
    const pictures = [...document.images];
    await Promise.all(pictures.map(one => one.decode().catch(() => null)));
    return pictures.filter(one => one.naturalWidth === 0).map(one => one.getAttribute("src"));
}"""
_LOOKS = """() => {
    const lightness = color => {
        const [r, g, b] = color.match(/[0-9.]+/g).slice(0, 3).map(Number).map(c => c / 255)
            .map(c => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
        return 0.2126 * r + 0.7152 * g + 0.0722 * b;
    };
    const isClear = color => /^rgba.*, 0\\)$/.test(color);
    const text = document.querySelector("article p") || document.body;
    let behind = text;
    while (behind.parentElement && isClear(getComputedStyle(behind).backgroundColor))
        behind = behind.parentElement;
    const color = getComputedStyle(behind).backgroundColor;
    const ground = isClear(color) ? 1 : lightness(color);
    const front = lightness(getComputedStyle(text).color);
    const ratio = (Math.max(ground, front) + 0.05) / (Math.min(ground, front) + 0.05);
    return [document.documentElement.scrollWidth, window.innerWidth, ratio, ground];
}"""


def browser_path() -> str | None:
    """Path of a browser on this machine."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


def pages_of(site: Path) -> list[Path]:
    """All pages but those in `_static`."""
    return [file for file in sorted(site.rglob("*.html")) if "_static" not in file.parts]


def read(browser: Any, site: Path) -> Iterator[str]:
    """What is wrong with the pages: each is loaded once, and seen in all `VIEWS`."""
    page = browser.new_page()
    troubles: list[str] = []
    page.on("console", lambda message: message.type == "error" and troubles.append(message.text))
    page.on("pageerror", lambda error: troubles.append(str(error)))
    for file in pages_of(site):
        name = file.relative_to(site)
        page.goto(file.as_uri())
        empty = page.evaluate(_EMPTY_PICTURES)  # before the width, which pictures change
        yield from (f"{name}: the picture {source} does not load" for source in empty)
        for scheme, viewport in VIEWS:
            page.emulate_media(color_scheme=scheme)
            page.set_viewport_size(viewport)
            where = f"{name} ({scheme}, {viewport['width']} px)"
            width, inner, contrast, ground = page.evaluate(_LOOKS)
            if width > inner:
                yield f"{where}: {width} px wide"
            if contrast < CONTRAST:
                yield f"{where}: contrast of text {contrast:.1f}, less than {CONTRAST}"
            if (ground < 0.2) != (scheme == "dark"):
                yield f"{where}: the background is {'dark' if ground < 0.2 else 'light'}"
        yield from (f"{name}: {trouble}" for trouble in troubles)
        troubles.clear()
    page.close()


def searched(
    browser: Any, site: Path, searches: dict[str, str], wait: int = SEARCH_WAIT
) -> Iterator[str]:
    """Searches, typed into the box of the front page, that do not find their page."""
    page = browser.new_page(viewport=SCREEN)
    for words, goal in searches.items():
        page.goto((site / "index.html").as_uri())
        page.locator("input[name=q]").first.fill(words)
        page.locator("input[name=q]").first.press("Enter")
        try:
            page.wait_for_selector(f'#search-results a[href*="{goal}"]', timeout=wait)
        except Exception as error:
            if type(error).__name__ != "TimeoutError":
                raise
            yield f"the search for {words!r} does not find {goal}"
    page.close()


def films(browser: Any, site: Path, wait: int = FILM_WAIT) -> Iterator[str]:
    """Films of the front page and of the gallery that show one frame only."""
    page = browser.new_page(viewport=SCREEN)
    for name in ("index.html", "gallery.html"):
        page.goto((site / name).as_uri())
        shown = page.locator('article img[src$=".webp"]:not(.sd-card-img-top)').all()
        if not shown:
            yield f"{name} has no film"
        for film in shown:
            film.scroll_into_view_if_needed()
            first, waited = film.screenshot(), 0
            while waited < wait and film.screenshot() == first:
                page.wait_for_timeout(200)
                waited += 200
            if waited >= wait:
                yield f"{name}: the film {film.get_attribute('src')} does not play"
    page.close()


def wrong(browser: Any, site: Path) -> list[str]:
    """All that is wrong."""
    return [
        *read(browser, site),
        *searched(browser, site, SEARCHES),
        *films(browser, site),
    ]


def main() -> int:
    """Print what is wrong; 1 if anything is."""
    site, path = Path(sys.argv[1]).resolve(), browser_path()
    if path is None or find_spec("playwright") is None:
        print(f"not read in a browser: needs playwright and one of {', '.join(BROWSERS)}")
        return 0
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        found = wrong(browser, site)
        browser.close()
    print("\n".join(found) or f"{len(pages_of(site))} pages read in a browser, three times")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
