"""The report's files: what they hold, that names cannot become markup, that nothing is fetched."""

from __future__ import annotations

import base64
import csv
import html.parser
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fide_lab import compare, report
from fide_lab.compare import Configuration, Plan, StoredRun
from fide_lab.compare.results import NoResultsError
from fide_lab.report import plots, sentences, tables
from fide_lab.report.panel import panels, short_names
from fide_plugins.errors import OptionError

from .conftest import NASTY, curve, failed, missing, result, results

pytestmark = pytest.mark.figures


class Page(html.parser.HTMLParser):
    """Elements of a page with their attributes, and its text."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.text = ""
        self.feed(page.read_text("utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))

    def handle_data(self, data: str) -> None:
        self.text += data

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.elements if name == tag]


def test_names_cannot_become_markup_and_nothing_is_fetched(written: Path) -> None:
    page = Page(written)
    assert not page.all("script") and not page.all("b") and not page.all("i")
    for _, attributes in page.elements:
        assert not any(name.startswith("on") for name in attributes)
        for name in ("src", "href", "srcset", "data", "action"):
            assert attributes.get(name, "data:").startswith("data:")
    for name in NASTY.values():
        assert name in page.text, "as text it is all there"
    assert "raise ArithmeticError" in page.text and "<i>no</i> & 'never'" in page.text
    (policy,) = [a["content"] for a in page.all("meta") if "http-equiv" in a]
    assert "default-src 'none'" in policy


def test_everything_that_is_seen_can_be_read_aloud(written: Path) -> None:
    page = Page(written)
    assert len(page.all("img")) == 3 and all(a["alt"].strip() for a in page.all("img"))
    assert len(page.all("caption")) == len(page.all("table")) == 1
    assert all("scope" in a for a in page.all("th"))
    assert page.all("html")[0]["lang"] == "en" and len(page.all("h1")) == 1


def test_the_figures_hold_the_medians(written: Path, study: Path) -> None:
    for image in Page(written).all("img"):
        data = base64.b64decode(image["src"].removeprefix("data:image/png;base64,"))
        with Image.open(io.BytesIO(data)) as png:
            assert png.width > 300 and len(np.unique(np.asarray(png.convert("L")))) > 20
    (panel,) = panels(compare.read(study), {})
    lines = plots.convergence(panel, "renders").axes[0].lines
    ends = [float(np.asarray(line.get_ydata())[-1]) for line in lines]
    assert ends == pytest.approx([row.median for row in panel.rows])


def test_results_csv_has_a_line_for_each_cell(written: Path, study: Path) -> None:
    rows = list(csv.DictReader(io.StringIO((written.parent / "results.csv").read_text())))
    runs = compare.read(study).runs
    assert len(rows) == len(runs) == 6
    for row, stored in zip(rows, runs, strict=True):
        assert row["optimizer"] == stored.key.configuration and row["state"] == stored.state
        if stored.state == "finished":
            run = json.loads((stored.folder / "run.json").read_text())
            assert float(row["final_loss"]) == run["totals"]["best_loss"] == stored.final
            assert float(row["final_mse"]) == pytest.approx(stored.final)
        else:
            assert row["final_loss"] == "" and row["seed"] == "2"


def test_formulas_of_a_spreadsheet_are_led_by_an_apostrophe() -> None:
    text = tables.results_csv(results([result("=cmd|' /C calc'!A0", 0, 0.1)]))
    assert next(iter(csv.reader(io.StringIO(text.splitlines()[1]))))[2] == "'=cmd|' /C calc'!A0"


def test_the_winner_is_bold_and_differences_are_marked() -> None:
    runs = [result("a", s, 0.1 + s / 100) for s in range(6)]
    runs += [result("b", s, 0.3 + s / 90) for s in range(6)]
    (panel,) = panels(results(runs), {})
    table = tables.ranking(panel)
    first, second = table.rows
    assert [text for text in first if isinstance(text, tables.Strong)] == ["a", "0.125"]
    assert not any(isinstance(text, tables.Strong) for text in second)
    assert second[[title for title, _ in table.columns].index("p")] == "0.031 †"
    assert "significantly better than b" in sentences.summary(panel)


LONG = "dibo:batch=64:budget=600:precision=single:proposals=2:proxy_width=64:width=128"
MANY = ["fide", "cma", *(f"cma:popsize={k}" for k in range(10, 17)), "x" * 60, LONG]


def many() -> list[StoredRun]:
    """Eleven optimizers, some with long names, one of them with a shorter run."""
    runs = [
        result(configuration, s, 1e-7 * 5**i)
        for i, configuration in enumerate(MANY[:-1])
        for s in range(2)
    ]
    return [*runs, *(result(LONG, s, 0.5, end=60) for s in range(2))]


def test_options_that_tell_an_optimizer_from_nobody_are_left_out_and_said() -> None:
    names = short_names([*MANY, "ng:A:k=1:b=2", "ng:A:k=1:b=3", "ng:B:k=1"])
    assert len(set(names.values())) == len(names), "different ones stay different"
    assert names[LONG] == "dibo" and names["cma:popsize=10"] == "cma:popsize=10"
    assert names["ng:A:k=1:b=2"] == "ng:A:b=2" and names["ng:B:k=1"] == "ng:B"
    (panel,) = panels(results(many()), {})
    assert f"Here dibo is {LONG}." in sentences.summary(panel)
    assert "| dibo " in tables.markdown(tables.ranking(panel))


def test_one_run_of_one_optimizer_is_a_report_too(tmp_path: Path) -> None:
    plan = Plan(("spline",), (Configuration.parse("random"),), seeds=1, budget=12, size=16)
    compare.run(plan, tmp_path / "a")
    written = report.write(compare.read(tmp_path / "a"), tmp_path / "elsewhere" / "page.html")
    assert "random has the lowest median" in written.overview
    names = {path.name for path in (tmp_path / "elsewhere").iterdir()}
    assert names == {"page.html", "page-results.csv"}, "another report may lie there"


def test_what_cannot_be_reported_is_named(study: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="threshold is given for 'lpips', which is not"):
        report.write(compare.read(study), tmp_path / "a.html", {"lpips": 0.1})
    with pytest.raises(NoResultsError, match="no run in nowhere is finished"):
        report.write(results([missing("a", 0)]), tmp_path / "a.html")
    with pytest.raises(OptionError, match=r"NAME.html, not 'a.txt'"):
        report.write(compare.read(study), tmp_path / "a.txt")
    assert not list(tmp_path.iterdir())


def test_a_run_without_a_finite_loss_is_shown() -> None:
    stored = result("a", 0, None)
    (panel,) = panels(results([replace(stored, curve=curve([], [], 100))]), {})
    (text,) = plots.convergence(panel, "seconds").axes[0].texts
    assert text.get_text() == "no optimizer has a finite median"
    assert tables.ranking(panel).rows[0][3] == "none"


def test_failures_are_said_and_optimizers_without_a_finished_run_listed() -> None:
    runs = [result("a", s, 0.1 + s / 100) for s in range(6)]
    runs += [result("b", 0, 0.05), *(failed("b", s) for s in range(1, 6))]
    runs += [*(failed("c", s) for s in range(6)), *(missing("d", s) for s in range(6))]
    (panel,) = panels(results(runs), {})
    said = "11 of 24 runs failed and count as infinite: b 5 of 6, c 6 of 6."
    assert said in sentences.summary(panel)
    table = tables.ranking(panel)
    shown = {row[0]: list(row) for row in table.rows}
    assert list(shown) == ["a", "b", "c", "d"]
    assert shown["b"][:2] == ["b", "1 of 6"] and shown["c"][:2] == ["c", "0 of 6"]
    assert shown["d"][1] == "0 of 6" and set(shown["d"][2:]) == {""}
    titles = [title for title, _ in table.columns]
    at = [titles.index(title) for title in ("median mse", "success", "times winner")]
    assert [shown["c"][i] for i in at] == ["none", "0 of 6", "over 1,000"]


def test_equal_and_infinite_medians_are_no_victory() -> None:
    runs = [result(n, s, v) for n, v in (("a", 0.0), ("b", 0.0), ("c", 0.2)) for s in range(8)]
    (panel,) = panels(results(runs), {})
    said = sentences.summary(panel)
    assert said.startswith("a and b share the lowest median, 0. a is significantly better than c.")
    rows = tables.ranking(panel).rows
    assert [isinstance(row[0], tables.Strong) for row in rows] == [True, True, False]
    assert not any("winner" in row for row in rows)
    (panel,) = panels(results([result(n, s, None) for n in "ab" for s in range(6)]), {})
    assert "No optimizer has a finite median. Success is any finite" in sentences.summary(panel)
    assert not any(isinstance(t, tables.Strong) for row in tables.ranking(panel).rows for t in row)


def test_optimizers_are_chosen_by_name(study: Path, tmp_path: Path) -> None:
    every = compare.read(study)
    other = next(label for label in every.optimizers if label != "cma")
    few = every.of(["cma"])
    assert few.optimizers == ["cma"] and few.not_shown == (other,) and few.of(["cma"]).runs
    assert every.of(every.optimizers[::-1]).runs == every.runs
    written = report.write(few, tmp_path / "few.html")
    assert "Not shown: <script>" in written.overview
    assert "Not shown: &lt;script&gt;" in written.page.read_text()
    rows = list(csv.DictReader(io.StringIO((tmp_path / "few-results.csv").read_text())))
    assert {row["optimizer"] for row in rows} == {"cma"}
    with pytest.raises(OptionError, match="unknown optimizer of .*'cna'.*did you mean 'cma'"):
        every.of(["cma", "cna"])
