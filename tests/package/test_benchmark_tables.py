"""Tables of the benchmarks, from rows made by hand: what pages say is copied from these."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import shutil
import sys
import threading
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from fide_lab import optimizers
from fide_lab.compare import Results, RunKey, StoredRun
from fide_lab.compare.results import AXES, Curve
from fide_plugins import FIDE
from fide_tasks.lamps import Lamps

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
pytestmark = pytest.mark.skipif(not BENCHMARKS.exists(), reason="the benchmarks are not here")


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Imports a program of `benchmarks/`."""
    monkeypatch.setenv("OMP_NUM_THREADS", os.environ.get("OMP_NUM_THREADS", "1"))  # they set it
    registry = optimizers._REGISTRY  # some register more
    monkeypatch.setattr(registry, "_factories", dict(registry._factories))
    monkeypatch.syspath_prepend(BENCHMARKS)
    before = set(sys.modules)

    def load(name: str) -> ModuleType:
        return importlib.import_module(name)

    yield load
    for name in set(sys.modules) - before:
        if str(BENCHMARKS) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


def test_moves_count_runs_of_one_budget_and_take_the_middle_of_two(program: Any) -> None:
    def row(solved_at: int | None, budget: int) -> dict[str, Any]:
        return {"scene": "arm", "configuration": "fide", "size": 64, "budget": budget,
                "solved_at": solved_at}  # fmt: skip

    rows = [row(300, 500), row(None, 500), row(400, 1000), row(900, 1000)]
    lines = program("moves").table(rows).splitlines()[2:]
    assert lines == [
        "| arm | fide | 64 | 2 | inf | 0 | 1 |  |  |  |  |  |  |  |",
        "| arm | fide | 64 | 2 | 650 | 0 | 1 | 2 |  |  |  |  |  |  |",
    ]


def test_the_suite_is_run_and_read_at_its_own_budgets(program: Any) -> None:
    suite = program("suite")
    definition = suite.read("image-fitting-v1")
    assert [suite.budget_of(definition, n) for n in (None, 500)] == [10_000, 500]
    with pytest.raises(SystemExit, match="no budget of 501 renders; it has 500, 2000, 10000"):
        suite.budget_of(definition, 501)
    runs = list(suite.planned(definition, ["arm", "lens"], ["cma"], 2))
    assert [run["problem"] for run in runs] == ["arm-0", "lens-0", "arm-1", "lens-1"]


def test_an_optimizer_of_the_suite_has_one_name_and_the_suite_s_budget(
    program: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    suite = program("suite")
    assert suite.label_of("dibo:width=128:batch=64") == "dibo:batch=64:width=128"
    with pytest.raises(SystemExit, match="npe:budget=500 has a budget of its own"):
        suite.label_of("npe:budget=500")
    monkeypatch.setattr(sys, "argv", ["suite.py", "--targets", "11"])
    with pytest.raises(SystemExit, match="image-fitting-v1 has 10 targets, not 11"):
        suite.main()


def test_forward_counts_runs_that_do_not_get_there(program: Any) -> None:
    reached = program("forward")._reached
    assert reached([10, 30, None]) == "30 (2/3)"
    assert reached([10, None, None]) == "- (1/3)"


def test_quality_has_medians_where_all_runs_are(program: Any) -> None:
    quality = program("quality")
    rows = [
        {"configuration": "FIDE", "best": {"500": loss, **more}}
        for loss, more in ((0.1, {"1000": 0.01}), (0.3, {}), (0.2, {"1000": 0.02}))
    ]
    assert quality.medians_of(rows, "FIDE", ["500", "1000"]) == {"500": 0.2}
    task = {"task": "voronoi", "size": 64, "task_options": {"cells": 3}}
    assert quality.scene_of(task) == "voronoi, cells = 3, 64x64"
    medians = {"FIDE": {"500": 0.1}, "CMA-ES, k = 50": {"500": 0.4}, "CMA-ES": {"500": 0.2}}
    assert quality.leads(medians, ["500", "1000"]) == "0.50 | "


def paper_row(configuration: str, budget: int, loss: float, target: int = 0) -> dict[str, Any]:
    marks = [m for m in (1000, 5000, 10_000) if m < budget] + [budget]
    return {
        "task": "voronoi", "loss": "mse", "size": 112, "seed": 0, "target": target,
        "configuration": configuration, "budget": budget,
        "best": {str(m): loss * (2 if m < budget else 1) for m in marks},
        "cross": {str(m): {"mse": loss * (2 if m < budget else 1)} for m in marks},
    }  # fmt: skip


def test_of_the_paper_only_the_longest_run_counts(program: Any) -> None:
    paper_tables = program("paper_tables")
    short, long = paper_row("FIDE", 5000, 0.3), paper_row("FIDE", 25_000, 0.1)
    assert paper_tables.longest([long, short]) == [long]
    other = paper_row("ZeroGrads", 25_000, 0.2)
    assert paper_tables.lowest([long], [long, other]) == "1 of 1"
    assert paper_tables.lowest([other], [long, other]) == "0 of 1"
    alone = paper_row(next(iter(paper_tables.AFFORDABLE)), 600, 0.2)
    assert paper_tables.lowest([alone], [alone]) == "-"


def test_of_the_paper_the_last_column_is_the_end(program: Any) -> None:
    rows = [paper_row("FIDE", 20_000, 0.1)]
    lines = program("paper_tables").section("voronoi", "mse", rows, ["FIDE", "ZeroGrads"])
    assert "| mse, 1,000 | mse, 5,000 | mse, 10,000 | mse, 20,000 |" in lines[2]
    assert lines[4].startswith("| FIDE | - | 0 of 1 | 1 | 0.2 | 0.2 | 0.2 | 0.1 |")
    assert lines[5].startswith("| ZeroGrads | - | - | 0 | - |")


def test_backbones_are_compared_where_both_ran(program: Any) -> None:
    paper, tables = program("paper"), program("paper_tables")
    both = [
        paper_row(name, 25_000, loss)
        for name, loss in ((paper.PUBLISHED, 0.3), (paper.PRETRAINED, 0.2))
    ]
    alone = paper_row(paper.PUBLISHED, 25_000, 0.1, target=1)
    lines = tables.backbones([*both, alone])[2:]
    assert [line.split(" | ")[1] for line in lines] == ["`patch`", "`efficientnet`"]
    assert [
        line.rstrip(" |").endswith(end) for line, end in zip(lines, ("0.3", "0.2"), strict=True)
    ] == [True] * 2


def test_races_with_authors_count_ties_for_nobody(program: Any) -> None:
    rows = [{"ours": ours, "theirs": 1.0} for ours in (0.5, 0.5, 0.5, 0.5, 0.5, 1.0, 1.0)]
    (line,) = program("authors").line("x", rows)
    assert line == "| x | 5 of 7 | 0.50 | 0.062 |"


def test_of_a_suite_the_longest_run_of_a_problem_counts(program: Any) -> None:
    suite = program("suite")
    definition = suite.read("image-fitting-v1")

    def row(solved_at: int | None, *losses: float) -> dict[str, Any]:
        marks = dict(zip(("500", "2000", "10000"), losses, strict=False))
        return {"problem": "lamps-0", "optimizer": "fide", "solved_at": solved_at, "losses": marks}

    rows = [row(None, 0.1, 0.1), row(400, 1e-6, 1e-6, 1e-7)]
    for order in (rows, rows[::-1]):
        found = suite.scores(definition, order, ["fide"], 2000)
        assert found.t.tolist() == [[400]] and found.budgets == (500, 2000)
        np.testing.assert_array_equal(found.losses[:, 0, 0], 1e-6)
    with pytest.raises(SystemExit, match="two rows of one run"):
        suite.scores(definition, [rows[0], rows[0]], ["fide"], 2000)


def test_a_run_of_a_suite_is_gone_on_with_where_it_was_stopped(
    program: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    suite = program("suite")
    definition = suite.read("image-fitting-v1")
    parts = tmp_path / "rows.parts"
    measure = partial(suite.measure, definition, 500, parts)
    run = {"problem": "lamps-0", "optimizer": "cma"}
    whole = measure(run)
    shutil.rmtree(suite.part_of(500, parts, run))
    assert not any(parts.iterdir())
    batches: list[int] = []
    plain = Lamps.render

    def render(task: Any, X: Any, seed: Any = None) -> Any:
        before = sum(batches)
        batches.append(len(X))
        if before <= 300 < sum(batches):
            raise KeyboardInterrupt
        return plain(task, X, seed)

    monkeypatch.setattr(Lamps, "render", render)
    with pytest.raises(KeyboardInterrupt):
        measure(run)
    again = measure(run)
    assert again | {"seconds": 0} == whole | {"seconds": 0}
    assert 500 <= sum(batches) <= 500 + 3 * max(batches)  # the target twice, one batch twice


def test_nothing_but_its_row_is_left_of_a_finished_run(
    program: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    suite, paper, out = program("suite"), program("paper"), tmp_path / "rows.jsonl"
    words = ["--scenes", "lamps", "--optimizers", "cma", "--targets", "1", "--budget", "500"]
    monkeypatch.setattr(sys, "argv", ["suite.py", *words, "--out", str(out)])
    suite.main()
    assert len(out.read_text().splitlines()) == 1
    assert not any(out.with_suffix(".parts").iterdir())
    for cell in list(paper.grid(["mse", "rendered"]))[::5]:
        place = paper.part_of(tmp_path, cell)
        if place is not None:
            place.mkdir()
        paper.clear(tmp_path, cell)
        assert place is None or not place.exists()


def test_finished_runs_of_a_comparison_are_taken_over_at_any_budget_of_the_suite(
    program: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    suite, out = program("suite"), tmp_path / "rows.jsonl"

    def run(problem: str, status: Any, found: Any = None) -> StoredRun:
        return StoredRun(RunKey(problem, "mse", "cma", 0), tmp_path, status, curve=found)

    at = {axis: np.array([1.0, 700.0]) for axis in AXES}
    curve = Curve(at, dict.fromkeys(AXES, 2000.0), np.array([0.1, 1e-6]), {})
    runs = [run("lamps-0", "finished", curve), run("lamps-1", "finished", curve)]
    runs += [run("arm-0", "failed"), run("arm-1", "missing"), run("lens-0", "missing")]
    settings = {"task_options": {"suite": "image-fitting-v1"}, "budget": 2000}
    calls = [{"started": "2026-11-27T10:00:00+00:00"}]
    there = Results(tmp_path, settings, calls, {"numpy": "2.4.6"}, {"cpu": "A"}, runs)
    shorter = {"problem": "lamps-0", "optimizer": "cma", "solved_at": None, "losses": {"500": 0.1}}
    as_long = shorter | {"problem": "lamps-1", "losses": {"500": 0.1, "2000": 0.1}}
    out.write_text("".join(json.dumps(row) + "\n" for row in (shorter, as_long)))
    monkeypatch.setattr(suite.results, "read", lambda folder: there)
    monkeypatch.setattr(sys, "argv", ["suite.py", "--from", "runs", "--out", str(out)])
    suite.main()
    said = f"1 of 5 runs are taken; 1 in {out} already; 1 failed; 2 missing\n"
    assert capsys.readouterr().out == said
    row = json.loads(out.read_text().splitlines()[-1])
    assert (row["problem"], row["solved_at"]) == ("lamps-0", 700)
    assert row["losses"] == {"500": 0.1, "2000": 1e-6}
    assert suite.origin([row]).machine["days"] == "2026-11-27 to 2026-11-27"
    there.settings["budget"] = 600
    with pytest.raises(SystemExit, match="no budget of 600 renders; it has 500, 2000, 10000"):
        suite.main()


def test_the_page_of_a_suite_says_what_made_its_rows(
    program: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows of two processors and of two versions of a package; other optimizers' are no part."""
    suite, out = program("suite"), tmp_path / "rows.jsonl"

    def row(optimizer: str, solved_at: int | None, cpu: str, numpy: str) -> dict[str, Any]:
        return {"problem": "lamps-0", "optimizer": optimizer, "solved_at": solved_at,
                "losses": {"500": 1e-3 if solved_at is None else 1e-6}, "date": "2026-11-26",
                "machine": {"cpu": cpu}, "packages": {"numpy": numpy}}  # fmt: skip

    rows = [row("fide", 400, "A", "2.4.6"), row("cma", None, "B", "2.5.2"), row("eki", 9, "C", "3")]
    out.write_text("".join(json.dumps(one) + "\n" for one in rows))
    monkeypatch.setattr(sys, "argv", [
        "suite.py", "--budget", "500", "--optimizers", "fide,cma", "--out", str(out),
        "--page", str(tmp_path / "page" / "report.html"),
    ])  # fmt: skip
    suite.main()
    page, text = ((tmp_path / "page" / name).read_text() for name in ("report.html", "report.md"))
    assert "A, B" in page and "2.4.6, 2.5.2" in page and "suite.py --budget 500" in page
    assert "| fide      |         **1** |" in text and "1 of 110 problems" in text
    assert (tmp_path / "page" / "figures" / "performance-500.png").is_file()


def test_a_video_is_gone_on_with_where_it_was_killed(
    program: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether before a row was written, or between that and the optimizer's checkpoint."""
    retarget, out = program("retarget"), tmp_path / "rows.jsonl"
    usual = {"task": "voronoi", "frames": 3, "size": 24, "seed": 0, "fresh": 20, "most": 10,
             "preset": "balanced", "proposer": "linear"}  # fmt: skip

    def run(path: Path, **more: Any) -> None:
        retarget.run(argparse.Namespace(**{**usual, **more, "out": path}))

    def losses(path: Path, proposer: str) -> list[float]:
        return [
            row["loss"] for row in retarget.rows_of(path) if row["kind"] == "retarget"
            and row["proposer"] == proposer
        ]  # fmt: skip

    for proposer in ("linear", "none"):
        run(tmp_path / "whole.jsonl", proposer=proposer)
    save, kills = FIDE.save, iter([False, True, True, False, True])

    def killed(opt: FIDE, path: Any) -> None:
        if next(kills, False):
            raise KeyboardInterrupt
        save(opt, path)

    monkeypatch.setattr(FIDE, "save", killed)
    for proposer in ("linear", "none", "linear"):  # after frames 1, 0 and 2
        with pytest.raises(KeyboardInterrupt):
            run(out, proposer=proposer)
    for proposer in ("linear", "none"):
        run(out, proposer=proposer)
        whole = losses(tmp_path / "whole.jsonl", proposer)
        assert len(whole) == 3 and losses(out, proposer)[-3:] == whole
    assert len(losses(out, "linear")) == 3, "no frame is there twice"
    before = out.read_text()
    run(out)
    assert out.read_text() == before, "a finished video is not rendered again"
    assert [path.name for path in tmp_path.glob("*checkpoint")] == []


def test_the_table_of_videos_tells_configurations_apart(program: Any) -> None:
    retarget = program("retarget")
    rows = [
        {"task": "arm", "size": 64, "seed": 0, "frames": 60, "fresh": 2000, "preset": preset,
         "proposer": "linear", "kind": kind, "frame": frame, "renders": 10, "loss": 0.1,
         "goal": 0.2}
        for preset in ("balanced", "fast") for kind in ("fresh", "retarget") for frame in (0, 1)
    ]  # fmt: skip
    names = [line.split(" | ")[0] for line in retarget.table(rows).splitlines()[2:]]
    assert names == ["| arm, 64 px, seed 0, linear", "| arm, 64 px, seed 0, linear, preset fast"]


def test_simulated_workers_hand_out_what_is_due_first_when_all_are_taken(program: Any) -> None:
    """The last submitted render ends the waiting for others; no thread or time is in it."""
    workers = program("fit_workers").SimulatedWorkers(3, seed=0, budget=6)
    before, done = threading.active_count(), []
    for i in range(6):
        workers.submit(lambda i=i: i).add_done_callback(lambda future: done.append(future.result()))
        assert len(done) == (0, 0, 1, 2, 3, 6)[i]
    now, due, expected = 0.0, [], []
    for i, factor in enumerate(np.random.default_rng(0).uniform(0.9, 1.1, 6)):
        due.append((now + 0.1 * factor, i))
        while len(due) >= (3 if i < 5 else 1):
            now, first = min(due)
            due.remove((now, first))
            expected.append(first)
    assert done == expected and threading.active_count() == before


def test_noisy_renders_count_what_is_found_and_who_is_ahead(program: Any) -> None:
    noisy = program("noisy_renders")

    def row(problem: str, name: str, error: float) -> dict[str, Any]:
        best = 0.5 if name == "balanced, mse" else error
        return {"problem": problem, "optimizer": name, "error": error, "error_of_best": best}

    rows = [
        row(f"lamps-{i}", name, 0.001 if name == "balanced, mse" or i < 2 else 0.1)
        for i in range(6)
        for name in noisy.CONFIGURATIONS
    ]
    unfinished = row("arm-0", "balanced, mse", 0.2)
    lines = noisy.table([*rows, unfinished]).splitlines()
    assert lines[2] == "| balanced, mse | 6 | 0 | 0 | 0 | 6 | 0 | 0 | 0 | 0 | 0.001 | 0.5 |"
    assert lines[3] == "| accurate, mse | 2 | 0 | 0 | 0 | 2 | 0 | 0 | 0 | 0 | 0.1 | 0.1 |"
    # four of four, in seven of the ten pairs: p = 0.125, adjusted 0.125 * 10 / 7
    ahead = "balanced, mse and accurate, mse: found by only the first 4, the second 0, p = 0.18"
    assert f"- {ahead}" in lines
    ahead = "lower error of the first 6, the second 0, p = 0.031"
    assert f"- balanced, mse, recommended and lowest: {ahead}" in lines
    with pytest.raises(SystemExit, match="two rows of one run"):
        noisy.table([*rows, rows[0]])


def test_noise_belongs_to_the_render_and_none_to_the_answer(program: Any) -> None:
    noisy = program("noisy_renders")
    first, again = noisy.task_of("lamps-0"), noisy.task_of("lamps-0")
    X = np.random.default_rng(0).random((2, first.dim))
    images = first.render(X, seed=[3, 4])
    np.testing.assert_array_equal(again.render(X[1:], seed=[4])[0], images[1])
    clean = np.stack([first.reference(x) for x in X])
    inside = (clean > 0.3) & (clean < 0.7)  # six standard deviations from where noise is cut off
    assert np.std((images - clean)[inside]) == pytest.approx(noisy.NOISE, rel=0.02)
    for task, seed in ((first, 3), (noisy.task_of("lamps-1"), 4)):  # another render or target
        other = task.render(X[1:], seed=[seed])[0] - task.reference(X[1])
        assert abs(np.corrcoef(other[inside[1]], (images[1] - clean[1])[inside[1]])[0, 1]) < 0.1
    random = [first.error(x) for x in np.random.default_rng(1).random((200, first.dim))]
    assert np.median(random) / noisy.usual_error("lamps-0") == pytest.approx(1, abs=0.2)


def test_image_sizes_judge_all_answers_by_the_whole_image(program: Any) -> None:
    sizes = program("image_sizes")
    solved = sizes.SUITE.scenes["lamps"].solved

    def row(number: int, part: int, loss: float) -> dict[str, Any]:
        return {"problem": f"lamps-{number}", "part": part, "loss": loss, "seconds": float(part)}

    rows = [row(i, part, solved * (2 if part == 4 else 1)) for i in range(6) for part in (4, 2, 1)]
    lines = sizes.table([*rows, row(7, 1, 0.0)]).splitlines()
    assert "| lamps | 0 of 6 | 6 of 6 | 6 of 6 |" in lines
    assert "| mean seconds | 4.0 | 2.0 | 1.0 |" in lines
    assert "- only 1/4 solves 0, only the whole side 6, p = 0.031" in lines
    assert "- only 1/2 solves 0, only the whole side 0, p = 1" in lines
