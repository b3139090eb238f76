"""The report's files: what they hold, that names cannot become markup, that nothing is fetched."""

from __future__ import annotations

import csv
import html.parser
import io
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest
from PIL import Image

from fide_lab import compare, report
from fide_lab.compare import Configuration, Plan, StoredRun
from fide_lab.compare.results import NoResultsError
from fide_lab.report import plots, sentences, tables
from fide_lab.report.panel import panels, short_names
from fide_plugins.errors import OptionError

from .conftest import NASTY, failed, missing, result, results

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


def test_names_cannot_become_markup(written: Path) -> None:
    page = Page(written)
    assert len(page.all("script")) == 1, "our own"
    assert not any("src" in a and not a["src"].startswith("data:") for a in page.all("img"))
    assert not page.all("b") and not page.all("i")
    assert not any(name.startswith("on") for _, a in page.elements for name in a)
    for name in NASTY.values():
        assert name in page.text, "as text it is all there"
    assert "raise ArithmeticError" in page.text and "<i>no</i> & 'never'" in page.text


def test_the_page_is_whole_by_itself(written: Path) -> None:
    page = Page(written)
    for _, attributes in page.elements:
        for name in ("src", "href", "xlink:href", "srcset", "data", "action"):
            assert attributes.get(name, "#").startswith(("#", "data:"))
    text = written.read_text()
    assert "@import" not in text and not re.search(r"url\((?!#)", text)
    (policy,) = [a["content"] for a in page.all("meta") if "http-equiv" in a]
    assert "default-src 'none'" in policy
    assert len(text) < 1_000_000


def test_nothing_has_the_name_of_something_else(written: Path) -> None:
    page = Page(written)
    ids = [a["id"] for _, a in page.elements if "id" in a]
    assert len(ids) == len(set(ids))
    used = re.findall(r"(?:url\(#|href=\"#)([^)\"]+)", written.read_text())
    assert set(used) <= set(ids)


def test_everything_that_is_seen_can_be_read_aloud(written: Path) -> None:
    page = Page(written)
    assert all(a["alt"].strip() for a in page.all("img")) and len(page.all("img")) > 4
    for element in page.all("svg"):
        assert element.get("aria-hidden") == "true" or element["aria-label"].startswith(
            ("Best", "Milliseconds")
        )
    assert len(page.all("caption")) == len(page.all("table"))
    assert all("scope" in a for a in page.all("th"))
    assert page.all("html")[0]["lang"] == "en" and len(page.all("h1")) == 1


def test_colors_of_text_and_lines_stand_out() -> None:
    css = (Path(report.__file__).parent / "templates" / "page.css").read_text()
    light, dark = (
        dict(re.findall(r"--([\w-]+): (#\w{6})", part)) for part in css.split("@media")[:2]
    )
    assert set(light) == set(dark) >= set(plots.VARIABLES.values())
    for theme in (light, dark):
        for name in ("ink", "muted", "accent"):
            assert contrast(theme[name], theme["paper"]) >= 4.5  # WCAG 2.2, text
        for name in theme:
            if name.startswith("series"):
                assert contrast(theme[name], theme["paper"]) >= 3.0  # WCAG 2.2, graphics


def contrast(a: str, b: str) -> float:
    """Ratio of the relative luminances of two colors, as in WCAG 2.2."""

    def luminance(color: str) -> float:
        channels = np.array([int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)])
        linear = np.where(
            channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4
        )
        return float(linear @ [0.2126, 0.7152, 0.0722])

    high, low = sorted((luminance(a), luminance(b)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def test_the_figures_hold_the_medians(written: Path, study: Path) -> None:
    folder = written.parent / "figures"
    stems = {path.stem for path in folder.glob("*.svg")}
    assert len(stems) == 4 and len(list(folder.glob("*.png"))) == 5
    for path in folder.glob("*.png"):
        with Image.open(path) as png:
            assert png.width > 300 and len(np.unique(np.asarray(png.convert("L")))) > 20
    (panel,) = panels(compare.read(study), {})
    figure = plots.convergence(panel, "renders")
    lines = [line for line in figure.axes[0].lines if str(line.get_gid()).endswith("line")]
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
            assert int(row["rounds_of_8"]) == run["totals"]["rounds"]
        else:
            assert row["final_loss"] == "" and row["seed"] == "2"


def test_curves_csv_has_the_best_loss_at_marks(written: Path, study: Path) -> None:
    rows = list(csv.DictReader(io.StringIO((written.parent / "curves.csv").read_text())))
    for stored in compare.read(study).runs:
        mine = [row for row in rows if (row["optimizer"], row["seed"]) ==
                (stored.key.configuration, str(stored.key.seed))]  # fmt: skip
        if stored.curve is None:
            assert not mine
            continue
        marks = [int(row["renders"]) for row in mine]
        assert marks[0] == 1 and marks[-1] == 40 and marks == sorted(set(marks))
        expected = stored.curve.value("renders", marks)
        assert [float(row["best_loss"]) for row in mine] == pytest.approx(expected, rel=1e-5)


def test_formulas_of_a_spreadsheet_are_led_by_an_apostrophe() -> None:
    text = tables.results_csv(results([result("=cmd|' /C calc'!A0", 0, 0.1)]))
    assert next(iter(csv.reader(io.StringIO(text.splitlines()[1]))))[2] == "'=cmd|' /C calc'!A0"


def test_markdown_reads_as_a_table(written: Path) -> None:
    text = written.with_suffix(".md").read_text()
    tables_of = [block for block in text.split("\n\n") if block.startswith("| ")]
    assert len(tables_of) == 3
    for block in tables_of:
        lines = block.splitlines()
        assert len({len(line) for line in lines}) == 1, "aligned"
        bars = {len(re.findall(r"(?<!\\)\|", line)) for line in lines}
        assert len(bars) == 1
    assert "\\<script\\>" in text and "**" in text
    prose = "\n".join(line for line in text.splitlines() if not line.startswith("    "))
    assert not re.search(r"(?<!\\)<", prose), "names are no markup in headings and sentences"
    names = re.findall(r"\]\((figures/[^)]*)\)", text)
    assert len(names) == 2
    for name in names:
        assert (written.parent / unquote(name)).is_file()


def test_the_winner_is_bold_and_differences_are_marked() -> None:
    runs = [result("a", s, 0.1 + s / 100) for s in range(6)]
    runs += [result("b", s, 0.3 + s / 90) for s in range(6)]
    (panel,) = panels(results(runs), {})
    table = tables.ranking(panel)
    first, second = table.rows
    assert [entry.text for entry in first if entry.strong] == ["a", tables.number(0.125)]
    assert not any(entry.strong for entry in second)
    titles = [title for title, _ in table.columns]
    assert (
        second[titles.index("p")].text == "0.031 †" and second[titles.index("effect")].text == "1"
    )
    assert "significantly better than b" in sentences.verdict(panel)


def test_a_ratio_of_many_digits_is_not_written_out() -> None:
    """A winner at 1e-15 has found the answer; how many times lower it is says nothing more."""
    runs = [result("a", s, 1e-15) for s in range(3)] + [result("b", s, 2e-3) for s in range(3)]
    (panel,) = panels(results([*runs, *(result("c", s, 5e-13) for s in range(3))]), {})
    titles = [title for title, _ in tables.ranking(panel).columns]
    at = titles.index("times winner")
    assert [row[at].text for row in tables.ranking(panel).rows] == ["winner", "500", "over 1,000"]
    assert [row[at].sort for row in tables.ranking(panel).rows] == pytest.approx([1, 500, 2e12])


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
    assert [n for configuration, n in names.items() if configuration.startswith("ng")] == [
        "ng:A:b=2",
        "ng:A:b=3",
        "ng:B",
    ]
    (panel,) = panels(results(many()), {})
    assert sentences.abbreviations(panel) == f"Here dibo is {LONG}."
    assert "| dibo " in tables.markdown(tables.ranking(panel))


@pytest.mark.parametrize("legend", [True, False])
def test_all_text_of_a_figure_lies_within_it_and_beside_the_curves(legend: bool) -> None:
    from matplotlib.text import Text

    (panel,) = panels(results(many()), {})
    for figure in (plots.convergence(panel, "renders", legend), plots.times(panel, legend)):
        canvas: Any = figure.canvas
        canvas.draw()
        x, y = figure.axes[0].xaxis, figure.axes[0].yaxis
        beyond = {
            t.label1
            for axis in (x, y)
            for t in (*axis.majorTicks, *axis.minorTicks)
            if not axis.get_view_interval()[0] <= t.get_loc() <= axis.get_view_interval()[1]
        }
        texts: list[Any] = [t for t in figure.findobj(Text) if t.get_visible() and t.get_text()]
        texts = [t for t in texts if t not in beyond]
        said = {text.get_text() for text in texts}
        if figure.axes[0].lines:
            assert "best mse so far" in said and "1e-07" in said
        for text in texts:
            box = text.get_window_extent()
            assert box.x0 >= 0 and box.y0 >= 0, text
            assert box.x1 <= figure.bbox.x1 and box.y1 <= figure.bbox.y1, text
        if legend:
            key: Any = figure.axes[0].get_legend()
            box = key.get_window_extent()
            assert not box.shrunk(0.99, 0.99).overlaps(figure.axes[0].bbox)


def test_few_seeds_are_said_to_be_few() -> None:
    runs = [
        result(configuration, s, v + s)
        for configuration, v in (("a", 0.1), ("b", 0.2))
        for s in range(5)
    ]
    (panel,) = panels(results(runs), {})
    assert "With 5 pairs no difference can be significant" in sentences.verdict(panel)
    assert "below 0.062" in sentences.verdict(panel)
    assert "†" not in tables.markdown(tables.ranking(panel))


def test_pairs_that_are_too_few_for_many_rivals_are_said_to_be_so() -> None:
    runs = [result("best", s, 0.1 * 1.1**s) for s in range(6)]
    runs += [result("worse", s, 0.3 * 1.2**s) for s in range(6)]  # in every pair: p = 1 / 32
    for name in ("like", "alike"):
        runs += [result(name, s, 0.101 * 1.1 ** (s + (-1) ** s)) for s in range(6)]
    (panel,) = panels(results(runs), {})
    assert [row.label for row in panel.lowest] == ["best"]
    said = sentences.verdict(panel)
    assert "better in every pair than worse, but with 3 rivals there are too few pairs" in said
    assert said.endswith("The difference to like and alike may be chance.")
    assert "significantly better" not in said


def test_one_run_of_one_optimizer_is_a_report_too(tmp_path: Path) -> None:
    plan = Plan(("spline",), (Configuration.parse("random"),), seeds=1, budget=12, size=16)
    compare.run(plan, tmp_path / "a")
    written = report.write(compare.read(tmp_path / "a"), tmp_path / "elsewhere" / "page.html")
    assert "random has the lowest median" in written.overview
    names = {path.name for path in (tmp_path / "elsewhere").iterdir()}
    beside = {"page-results.csv", "page-curves.csv", "page-figures"}
    assert names == {"page.html", "page.md", *beside}, "another report may lie there"
    assert "](page-figures/images-spline-mse.png)" in written.page.with_suffix(".md").read_text()


def test_the_same_results_give_the_same_chart(study: Path, written: Path) -> None:
    (panel,) = panels(compare.read(study), {})
    (file,) = (written.parent / "figures").glob("convergence-*-renders.svg")
    assert plots.as_file(plots.convergence(panel, "renders")) == file.read_bytes()


def test_what_cannot_be_reported_is_named(study: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="threshold is given for 'lpips', which is not"):
        report.write(compare.read(study), tmp_path / "a.html", {"lpips": 0.1})
    with pytest.raises(NoResultsError, match="no run in nowhere is finished"):
        report.write(results([]), tmp_path / "a.html")
    with pytest.raises(OptionError, match="the page must be a file NAME.html, not 'a.md'"):
        report.write(compare.read(study), tmp_path / "a.md")
    assert not list(tmp_path.iterdir())


def test_a_missing_jinja2_is_named(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    missing: Any = None
    monkeypatch.setitem(sys.modules, "jinja2", missing)
    with pytest.raises(ImportError, match=r"pip install jinja2 .*extra report"):
        report.write(compare.read(study), tmp_path / "a.html")
    assert not list(tmp_path.iterdir())


def test_losses_that_never_were_finite_can_be_drawn(tmp_path: Path) -> None:
    from .conftest import curve

    stored = result("a", 0, None)
    assert stored.curve is not None
    (panel,) = panels(results([replace(stored, curve=curve([], [], 100))]), {})
    text = plots.in_page(plots.as_file(plots.convergence(panel, "seconds")), "p", "nothing")
    assert "no optimizer has a finite median" in text
    assert tables.ranking(panel).rows[0][2].text == "none"


def test_failures_are_said_and_optimizers_without_a_finished_run_listed() -> None:
    runs = [result("a", s, 0.1 + s / 100) for s in range(6)]
    runs += [result("b", 0, 0.05), *(failed("b", s) for s in range(1, 6))]
    runs += [*(failed("c", s) for s in range(6)), *(missing("d", s) for s in range(6))]
    (panel,) = panels(results(runs), {})
    said = sentences.failures(panel)
    assert said == "11 of 24 runs failed and count as infinite: b 5 of 6, c 6 of 6."
    table = tables.ranking(panel)
    shown = {row[0].text: [entry.text for entry in row] for row in table.rows}
    titles = [title for title, _ in table.columns]
    assert list(shown) == ["a", "b", "c", "d"]
    assert shown["b"][:2] == ["b", "1 of 6"] and shown["c"][:2] == ["c", "0 of 6"]
    assert shown["d"][1] == "0 of 6" and set(shown["d"][2:]) == {""}
    at = {title: titles.index(title) for title in ("median mse", "success", "times winner")}
    assert [shown["c"][i] for i in at.values()] == ["none", "0 of 6", "over 1,000"]
    assert shown["b"][at["success"]] == "1 of 6"
    each = {row[0].text: [entry.text for entry in row[1:]] for row in tables.losses(panel).rows}
    assert each["0"] == ["0.1", "0.05", "failed", ""]
    assert "It is better in every pair than c" in sentences.verdict(panel)
    assert "use at least 6 seeds" not in sentences.verdict(panel)


def test_seeds_that_are_missing_are_not_said_to_be_few() -> None:
    runs = [result(n, s, v + s) for n, v in (("a", 0.1), ("b", 0.2)) for s in range(3)]
    (panel,) = panels(results([*runs, *(missing(n, s) for n in "ab" for s in range(3, 6))]), {})
    assert "6 of 12 runs are not finished, continue with --resume" in sentences.verdict(panel)


@pytest.mark.thorough
def test_failures_reach_the_page_the_markdown_and_the_terminal(study: Path, written: Path) -> None:
    overview = report.write(compare.read(study), study / "report.html").overview
    said = f"1 of 6 runs failed and count as infinite: {NASTY['configuration']} 1 of 3."
    assert said in overview and said in Page(written).text
    assert tables.escaped(said) in written.with_suffix(".md").read_text()
    assert "\\" not in overview.replace("\\1", ""), "a terminal shows names without escapes"


@pytest.mark.thorough
def test_a_task_of_which_every_run_failed_is_named(study: Path, tmp_path: Path) -> None:
    there = compare.read(study)
    runs = [*there.runs, *(failed("cma", s, task="b_2") for s in range(2))]
    written = report.write(replace(there, runs=runs), tmp_path / "report.html")
    said = "b_2, mse: no run is finished, 2 of 2 failed."
    assert said in written.overview
    assert tables.escaped(said) in written.page.with_suffix(".md").read_text()


def test_equal_and_infinite_medians_are_no_victory() -> None:
    runs = [result(n, s, v) for n, v in (("a", 0.0), ("b", 0.0), ("c", 0.2)) for s in range(8)]
    (panel,) = panels(results(runs), {})
    said = sentences.verdict(panel)
    assert said.startswith("a and b share the lowest median, 0. The others are compared with a.")
    assert said.endswith("It is significantly better than c.")
    rows = tables.ranking(panel).rows
    assert [row[0].strong for row in rows] == [True, True, False]
    assert not any(entry.text == "winner" for row in rows for entry in row)
    (panel,) = panels(results([result(n, s, None) for n in "ab" for s in range(6)]), {})
    assert sentences.verdict(panel) == "No optimizer has a finite median."
    assert sentences.threshold(panel).startswith("Success is any finite mse, since no second")
    rows = tables.ranking(panel).rows
    assert not any(entry.strong or entry.text == "winner" for row in rows for entry in row)
    assert not any(e.strong for row in tables.losses(panel).rows for e in row)
    (panel,) = panels(results([result("a", 0, 0.1), result("b", 0, None)]), {})
    assert panel.success(panel.rows[0]).reached == 1 and panel.threshold == np.inf


def test_success_of_a_single_optimizer_is_no_second_best() -> None:
    alone, both = [result("a", s, 0.1) for s in range(3)], [result("b", s, 0.2) for s in range(3)]
    unstarted = [missing("b", s) for s in range(3)]
    for runs, said in ((alone, "only"), (alone + unstarted, "only"), (alone + both, "second best")):
        (panel,) = panels(results(runs), {})
        assert sentences.threshold(panel).endswith(f"or less, the {said} median.")
    (panel,) = panels(results([result("a", 0, None)]), {})
    assert sentences.threshold(panel).endswith("since the only median is not finite.")


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


def test_a_median_that_is_infinite_leaves_a_gap_and_its_band_reaches_the_top() -> None:
    runs = [result("a", s, 0.1) for s in range(4)] + [failed("a", s) for s in range(4, 9)]
    (panel,) = panels(results([*runs, *(result("b", s, 0.2) for s in range(9))]), {})
    figure = plots.convergence(panel, "renders")
    ends = [float(np.asarray(line.get_ydata())[-1]) for line in figure.axes[0].lines]
    assert ends == [np.inf, 0.2]
    assert np.isfinite(figure.axes[0].get_ylim()).all()
    text = plots.in_page(plots.as_file(figure), "p", "x").lower()
    assert "inf" not in text.replace("infinit", "") and "nan" not in text
    assert plots.describe(panel).endswith("medians at the end: b 0.2, a none.")


def test_the_page_states_the_size_of_the_pictures_as_they_are(study: Path, tmp_path: Path) -> None:
    there = compare.read(study)
    assert there.settings["size"] == 24
    runs = [r for r in there.runs if r.key.configuration == "cma"]
    for run in runs:
        run.run["settings"]["size"] = [18, 32]
    settings = there.settings | {"size": 224}  # as where the user's renderer has another one
    written = report.write(replace(there, settings=settings, runs=runs), tmp_path / "a.html")
    text = Page(written.page).text
    assert "1 optimizer, 3 seeds, 40 renders per run, 32 \N{MULTIPLICATION SIGN} 18 pixels" in text
    assert "224" not in text.split("Origin")[-1]
