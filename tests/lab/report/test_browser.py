"""The page in a real browser: no errors, and everything that can be pressed does what it says."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.figures


@pytest.fixture(scope="module")
def address(written: Path) -> str:
    return written.as_uri()


@pytest.fixture
def page(browser: Any, address: str) -> Iterator[Any]:
    """The page; afterwards nothing may have been complained of or fetched."""
    context = browser.new_context(viewport={"width": 1200, "height": 900})
    page = context.new_page()
    troubles: list[str] = []
    fetched: list[str] = []
    page.on("console", lambda message: troubles.append(message.text))
    page.on("pageerror", lambda error: troubles.append(str(error)))
    page.on("dialog", lambda dialog: troubles.append(dialog.message))
    page.on("request", lambda request: fetched.append(request.url))
    page.goto(address)
    yield page
    context.close()
    assert troubles == []
    assert [url for url in fetched if not url.startswith("data:")] == [address]


@pytest.mark.thorough
def test_the_axis_can_be_changed(page: Any) -> None:
    charts = page.locator(".charts")
    for button in charts.locator("button.axis").all():
        button.click()
        axis = button.get_attribute("data-axis")
        seen = [c.get_attribute("data-axis") for c in charts.locator(".chart:visible").all()]
        assert seen == [axis]
        pressed = charts.locator("button.axis[aria-pressed=true]").all()
        assert [b.get_attribute("data-axis") for b in pressed] == [axis]
        box = charts.locator(".chart:visible svg").bounding_box()
        assert box["width"] > 500 and box["height"] > 300
    assert len(charts.locator("button.axis").all()) == 3


def test_bands_and_optimizers_can_be_hidden(page: Any) -> None:
    chart = page.locator(".charts .chart:visible svg")

    def visible(name: str) -> int:
        shown = "e => getComputedStyle(e).display !== 'none'"
        script = f"(svg, name) => [...svg.querySelectorAll(name)].filter({shown}).length"
        count: int = chart.evaluate(script, name)
        return count

    assert (visible(".line"), visible(".mid"), visible(".wide"), visible(".legend")) == (2, 2, 2, 0)
    page.locator("input[data-part=wide]").uncheck()
    assert (visible(".line"), visible(".mid"), visible(".wide")) == (2, 2, 0)
    page.locator("input[data-series=s0]").uncheck()
    assert (visible(".s0"), visible(".s1.line"), visible(".s1.mid")) == (0, 1, 1)
    page.locator("input[data-series=s0]").check()
    page.locator("input[data-part=wide]").check()
    assert (visible(".line"), visible(".mid"), visible(".wide")) == (2, 2, 2)


def test_tables_can_be_sorted(page: Any) -> None:
    table = page.locator("table.sortable").first

    def names() -> list[str]:
        texts: list[str] = table.locator("tbody th").all_inner_texts()
        return texts

    before = names()
    title = table.locator("thead th", has_text="median").first
    title.locator("button").click()
    assert title.get_attribute("aria-sort") == "ascending" and names() == before
    title.locator("button").click()
    assert title.get_attribute("aria-sort") == "descending" and names() == before[::-1]
    table.locator("thead th button").first.click()
    assert names() == sorted(before) and title.get_attribute("aria-sort") == "none"


def test_it_can_be_used_without_a_mouse(page: Any) -> None:
    button = page.locator("button.axis").nth(1)
    button.focus()
    page.keyboard.press("Enter")
    assert page.locator(".charts .chart:visible").get_attribute("data-axis") == "seconds"
    page.keyboard.press("Tab")
    focused = page.evaluate("getComputedStyle(document.activeElement).outlineStyle")
    assert focused != "none"


def test_dark_and_light(browser: Any, address: str) -> None:
    looks = {}
    for scheme in ("light", "dark"):
        context = browser.new_context(color_scheme=scheme)
        page = context.new_page()
        page.goto(address)
        looks[scheme] = page.evaluate(
            """() => [getComputedStyle(document.body).backgroundColor,
                      getComputedStyle(document.querySelector(".chart text")).fill,
                      getComputedStyle(document.querySelector("g.line path")).stroke]"""
        )
        context.close()
    assert looks["light"][0] == "rgb(255, 255, 255)" and looks["dark"][0] == "rgb(20, 22, 26)"
    assert all(light != dark for light, dark in zip(*looks.values(), strict=True))


@pytest.mark.parametrize("width", [320, 375, 768])
def test_a_phone_shows_it_without_scrolling_sideways(
    browser: Any, address: str, width: int
) -> None:
    context = browser.new_context(viewport={"width": width, "height": 700}, is_mobile=True)
    page = context.new_page()
    page.goto(address)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    small = page.evaluate(
        """() => [...document.querySelectorAll(".chart:not([hidden]) text")].filter(
                 e => Math.abs(e.getBoundingClientRect().height - 4) < 4).length"""
    )
    assert small == 0, "text of a chart that nobody can read"
    context.close()


@pytest.mark.thorough
def test_many_optimizers_with_long_names_fit_a_phone_too(browser: Any, tmp_path: Path) -> None:
    from fide_lab import report

    from .conftest import results
    from .test_report import LONG, many

    made = results(many())
    made.settings.update(size=8, budget=100)
    written = report.write(made, tmp_path / "many.html").page
    context = browser.new_context(viewport={"width": 390, "height": 800}, is_mobile=True)
    page = context.new_page()
    page.goto(written.as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    first = page.locator("table.sortable tbody th").all()
    assert all(th.bounding_box()["width"] < 200 for th in first), "numbers have room beside it"
    assert LONG in page.locator("section").first.inner_text()
    context.close()


def test_a_screenshot_is_no_blank_page(page: Any, tmp_path: Path) -> None:
    import numpy as np
    from PIL import Image

    page.screenshot(path=tmp_path / "page.png", full_page=True)
    with Image.open(tmp_path / "page.png") as png:
        pixels = np.asarray(png.convert("RGB"))
    colors = pixels.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    assert pixels.shape[1] == 1200 and len(np.unique(colors)) > 500
