"""The suite: its definition, its problems, and a tiny part of it from the command line."""

from __future__ import annotations

import pickle
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab import suite as suites
from fide_lab.run.prepare import make_task
from fide_lab.suite import definition, problems
from fide_plugins import Float, Space, losses
from fide_plugins.cli import main
from fide_plugins.errors import OptionError
from fide_plugins.renderers.command import Template

pytestmark = pytest.mark.figures

SUITE = suites.read("image-fitting-v1")
NOISY = ("san_miguel", "beads")
NEEDS = {"robot": "mujoco", "san_miguel": "mitsuba", "beads": "mitsuba"}


def made(suite: suites.Suite, problem: str) -> Any:
    return make_task(problem, 0, 0, {"suite": suite.name})


def fide(*words: object) -> int:
    return main([str(word) for word in words])


def test_the_definition() -> None:
    names = ["image-fitting-foreign-v1", *(f"image-fitting-v{k}" for k in (1, 2, 3))]
    assert suites.names() == names
    assert SUITE.budgets == (500, 2000, 10_000)
    assert len(set(SUITE.targets)) == 10
    groups = [scene.group for scene in SUITE.scenes.values()]
    assert [groups.count(g) for g in ("paper", "folding", "exchangeable", "external")] == [
        5, 3, 2, 1,
    ]  # fmt: skip
    assert {scene.loss for scene in SUITE.scenes.values()} <= set(losses.names())
    assert pickle.loads(pickle.dumps(SUITE)).scenes.keys() == SUITE.scenes.keys()


@pytest.mark.thorough
@pytest.mark.parametrize("name", SUITE.scenes)
def test_every_scene_builds_and_its_truth_solves_it(name: str) -> None:
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    if name == "povray" and shutil.which("povray") is None:
        pytest.skip("needs the program povray")
    scene, task = SUITE.scenes[name], made(SUITE, f"{name}-3")
    x = getattr(task, "x_star", None)
    assert x is not None and x.shape == (task.dim,)
    if name in NOISY:  # the target alone takes seconds; it is made in the tests of tasks
        return
    loss = losses.make(scene.loss, task.target)
    truth, start = loss(task.render(np.stack([x, np.full(task.dim, 0.5)])))
    assert truth <= scene.solved < 0.5 * start


@pytest.mark.parametrize("folder", ["plain", "two words", "it's", "{out}", 'a "b" {c'])
def test_a_program_finds_its_scene_wherever_the_package_lies(
    folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(definition, "_FOLDER", tmp_path / folder)
    entry = {"group": "external", "loss": "mse", "solved": 0.1, "space": "s.toml"}
    entry |= {"command": f"'{sys.executable}' {{scenes}}/scene.py {{x}} {{out}}"}
    scene = definition._scene("own", entry, (0,))
    words = Template(scene.options["command"], Space(x=Float(0, 1))).command({"x": 0.5}, "o", "p")
    assert words == [sys.executable, str(tmp_path / folder / "scenes" / "scene.py"), "0.5", "o"]


@pytest.mark.parametrize(("name", "n"), [("image-fitting-v2", 10), ("image-fitting-v3", 20)])
def test_later_suites_have_the_same_scenes_and_other_targets(name: str, n: int) -> None:
    later = suites.read(name)
    there = {key: replace(scene, targets=SUITE.targets) for key, scene in later.scenes.items()}
    assert there == SUITE.scenes
    assert later.budgets == SUITE.budgets
    assert len(set(later.targets)) == len(later.targets) == n
    for other in set(suites.names()) - {name}:
        assert not set(later.targets) & set(suites.read(other).targets)
    ours, theirs = (made(suite, "lamps-0").target for suite in (SUITE, later))
    assert not np.array_equal(ours, theirs)


@pytest.mark.parametrize("name", ["lamps-10", "lamp-0", "lamps", "lamps-00", "lamps--1"])
def test_unknown_problems(name: str) -> None:
    with pytest.raises(ValueError, match=re.escape(f"unknown problem {name!r} of image-fitting")):
        made(SUITE, name)


def test_a_problem_has_no_other_option() -> None:
    with pytest.raises(OptionError, match="does not leave spp open"):
        make_task("beads-0", 0, 0, {"suite": SUITE.name, "spp": 4})


def test_what_cannot_be_rendered_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    why = problems.unavailable(SUITE, ["povray", "arm"])
    assert list(why) == ["povray"] and "no program 'povray' that may be executed" in why["povray"]


def test_a_part_from_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", "")
    out = tmp_path / "out"
    words = ["compare", "--suite", "image-fitting-v1", "--scenes", "povray,lamps", "--out", out]
    words += ["--targets", 1, "--budget", 40]
    assert fide(*words, "--optimizers", "cma,random") == 0
    printed = capsys.readouterr()
    assert "povray of image-fitting-v1 is left out, it cannot be rendered" in printed.err
    assert "image-fitting-v1: 2 runs of 40 renders (--scenes, --targets" in printed.err
    assert "This is a part of the suite image-fitting-v1: 1 of 110 problems" in printed.out
    assert fide(*words, "--optimizers", "cma,eki:popsize=20", "--resume") == 0
    lines = (out / "solved.csv").read_text().splitlines()
    assert lines[0] == "problem,target,optimizer,solved_at,loss_40"
    assert [line.split(",")[:3] for line in lines[1:]] == [
        ["lamps-0", "1000", name] for name in ("cma", "random", "eki:popsize=20")
    ]
    text = (out / "report.html").read_text()
    assert text.count("<img ") == 1 and "1 of 110 problems" in text
    assert "3 optimizers, 1 problem of 1 scene, read at 40 renders" in text
    assert "eki:popsize=20" in text and "fide compare --suite" in text
    before = {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()}
    assert fide("report", out, "-o", out / "a b.html") == 0
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.name in before} == before
    assert (out / "a b-solved.csv").read_text() == (out / "solved.csv").read_text()
    assert fide("report", out, "-o", out / "page.txt") == 2


BREAKS = """
import numpy as np


class Breaks:
    def __init__(self, dim, target):
        self.dim, self.breaks = dim, target[0, 0].sum() < THRESHOLD

    def ask(self, n):
        return np.full((n, self.dim), 0.5)

    def tell(self, X, losses):
        if self.breaks:
            raise ArithmeticError("out of luck")
"""


def test_failed_runs_are_unsolved_and_open_ones_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    corners = [made(SUITE, f"lamps-{k}").target[0, 0].sum() for k in range(3)]
    (tmp_path / "mine.py").write_text(BREAKS.replace("THRESHOLD", repr(float(max(corners)))))
    words = ["compare", "--suite", "image-fitting-v1", "--scenes", "lamps", "--budget", 40]
    words += ["--targets", 3, "--optimizers", "random,mine.py:Breaks"]
    assert fide(*words, "--out", "out") == 1
    printed = capsys.readouterr()
    assert "2 of 6 runs failed; error.txt in their directories has the tracebacks" in printed.err
    broken = [f"lamps-{k}" for k in range(3) if corners[k] < max(corners)]
    sentence = (
        "Failed runs count as unsolved, 2 problems: mine.py:Breaks (failed) on "
        f"{', '.join(broken)}."
    )
    assert "3 of 110 problems" in printed.out and sentence in printed.out
    assert sentence in Path("out/report.html").read_text()
    rows = [line.split(",") for line in Path("out/solved.csv").read_text().splitlines()]
    for problem in broken:
        assert [problem, "", "inf"] in [[r[0], *r[3:]] for r in rows if r[2] == "mine.py:Breaks"]

    shutil.rmtree(next(Path("out/cells/lamps-1").glob("*/random")))
    assert fide("report", "out") == 0
    printed = capsys.readouterr()
    assert "2 of 110 problems" in printed.out
    assert "Left out, 1 problem: random (missing) on lamps-1." in printed.out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["voronoi"], "a TASK has no meaning with --suite"),
        (["--losses", "mse"], "--losses has no meaning with --suite"),
        (["--scenes", "lamp"], "unknown scene of image-fitting-v1 'lamp'.*did you mean 'lamps'"),
        (["--targets", "11"], "has 10 targets, not 11"),
        (
            ["--optimizers", "cma,fide:budget=50"],
            "fide:budget=50 has a budget.*give .* --budget 50",
        ),
        (["--optimizers", "cma,rnadom"], "unknown optimizer 'rnadom'.*did you mean 'random'"),
        (["--optimizers", "cma:popsie=9"], "cma has no option 'popsie'; its options: .*popsize"),
        (["--optimizers", "cma,cma"], "the optimizer 'cma' is named twice"),
        (["--suite", "image-fitting"], "unknown suite 'image-fitting'.*image-fitting-v1"),
    ],
)
def test_wrong_usage_is_seen_before_a_scene_is_rendered(
    words: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(problems, "unavailable", lambda *_: pytest.fail("scenes were rendered"))
    out = tmp_path / "out"
    assert fide("compare", "--suite", "image-fitting-v1", *words, "--out", out) == 2
    assert re.search(message, capsys.readouterr().err)
    assert not out.exists()
