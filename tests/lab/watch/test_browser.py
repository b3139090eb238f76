"""The page in a real browser: it updates, fits a phone, is dark or light, fetches nothing else."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from fide_lab.watch import Server

from .conftest import write_curve, write_picture

playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")


def titled(page: Any, text: str) -> None:
    """Wait for a title that begins so."""
    playwright.expect(page).to_have_title(re.compile(f"^{re.escape(text)}"))


@pytest.mark.thorough
def test_it_updates_and_complains_of_nothing(browser: Any, server: Server, directory: Path) -> None:
    page = browser.new_page(viewport={"width": 1000, "height": 900})
    troubles: list[str] = []
    fetched: list[str] = []
    page.on("console", lambda message: troubles.append(message.text))
    page.on("pageerror", lambda error: troubles.append(str(error)))
    page.on("request", lambda request: fetched.append(request.url))
    page.goto(server.url)
    titled(page, "0.002")
    text = page.locator("main").inner_text()
    for shown in ("scene.py:render", "120 of 500", "1 min 15 s", "12.5", "deg"):
        assert shown in text
    assert "<b>wood</b>" in text, "text of a run is text, never HTML"
    assert page.locator("#status").inner_text() == "running"
    for name in ("figure > .target", "figure > .best", "#difference .best"):
        playwright.expect(page.locator(name)).to_have_js_property("naturalWidth", 16)
    line = page.locator("#line").get_attribute("d")
    before = page.locator("figure > .best").get_attribute("src")

    write_picture(directory / "best.png", 199)
    write_curve(directory, 300, 0.0001)
    titled(page, "1.00e-4")
    assert page.locator("#line").get_attribute("d") != line
    assert page.locator("figure > .best").get_attribute("src") != before
    page.close()
    assert troubles == []
    assert all(url.startswith((server.url, "data:")) for url in fetched)


CUT = """() => {
    const box = document.getElementById("curve").getBoundingClientRect();
    return [...document.querySelectorAll("#ticks text")].filter((text) => {
        const own = text.getBoundingClientRect();
        return own.left < box.left || own.right > box.right || own.bottom > box.bottom;
    }).map((text) => text.textContent);
}"""
"""Labels that reach beyond the picture of the curve."""


@pytest.mark.parametrize(
    ("best", "ticks"),
    [
        (0.0, ["0", "1e-2", "1e-1", "1e0"]),  # zero below the others of a logarithmic axis
        (1e-11, ["1e-11", "1e-8", "1e-5", "1e-2"]),
        (-1.5, ["-1.5", "-1", "-0.5", "0", "0.5"]),
        (-987654.3, ["-9.88e+5", "-7.41e+5", "-4.94e+5", "-2.47e+5", "0.5"]),
    ],
)
def test_losses_of_zero_and_below_have_a_curve(
    best: float, ticks: list[str], browser: Any, server: Server, directory: Path
) -> None:
    lines = ["0,0.5,0.5,0.1", "1,0.03,0.03,0.2", *(f"{i},1,0.03,1" for i in range(2, 119))]
    table = ["evaluation,loss,best_loss,seconds", *lines, f"119,{best},{best},2"]
    (directory / "curve.csv").write_text("\n".join(table) + "\n")
    page = browser.new_page()
    page.goto(server.url)
    playwright.expect(page.locator("#ticks text")).to_have_count(len(ticks) + 1)
    assert page.locator("#ticks text").all_text_contents() == [*ticks, "120 renders"]
    heights = [float(y) for y in re.findall(r"V([\d.]+)", page.locator("#line").get_attribute("d"))]
    bottom = page.evaluate("document.getElementById('curve').clientHeight") - 35
    assert len(heights) == 2 and heights[-1] == pytest.approx(bottom), "down to the end of the axis"
    assert page.evaluate(CUT) == []
    page.close()


@pytest.mark.thorough
def test_it_says_when_nobody_answers(browser: Any, directory: Path) -> None:
    from fide_lab.watch import serve

    server, url = serve(directory)
    page = browser.new_page()
    page.goto(url)
    titled(page, "0.002")
    server.close()
    playwright.expect(page.locator("#status")).to_contain_text("may have ended")
    page.close()


def test_another_site_cannot_read_it(browser: Any, server: Server, tmp_path: Path) -> None:
    """A page from elsewhere gets neither the data nor the pictures."""
    page = browser.new_page()
    page.goto("about:blank")
    read = f"fetch('{server.url}state.json').then(r => r.text()).catch(() => 'refused')"
    assert page.evaluate(read) == "refused"
    picture = f"""new Promise(done => {{
        const image = new Image();
        image.onload = () => done("shown");
        image.onerror = () => done("refused");
        image.src = "{server.url}best.png";
    }})"""
    assert page.evaluate(picture) == "refused"
    page.close()
