"""What is told of a flag, a command or a name that is not known."""

from __future__ import annotations

import argparse

import pytest

from fide_plugins.cli import suggestion

from .conftest import fide, one_line

FIT = ("fit", "target.png", "--renderer", "scene.py:render")


@pytest.mark.parametrize(
    ("words", "end"),
    [
        ((*FIT, "--budgt", 10), "did you mean --budget?"),
        ((*FIT, "--worker=2"), "did you mean --workers?"),
        ((*FIT, "--budget", 3, "--losss", "mse"), "did you mean --loss?"),
        (("run", "voronoi", "--bugdet", 5), "did you mean --budget?"),
        (("run", "voronoi", "--until"), "--until is of fide fit"),
        (
            ("solutions", "out", "--task-seed", 3),
            "--task-seed is of fide run and fide compare and fide tradeoff",
        ),
        (
            ("check", "scene.py:render", "--budget", 3),
            "--budget is of fide fit and fide run and fide compare",
        ),
        (("rn", "voronoi"), "did you mean 'run'?"),
        (("list", "task"), "did you mean 'tasks'?"),
        (("fit", "target.png", "--model", "voronoii"), "did you mean 'voronoi'?"),
    ],
)
def test_the_flag_or_the_word_that_was_meant(
    words: tuple[object, ...], end: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fide(*words) == 2
    assert one_line(capsys).rpartition("; see fide")[0].endswith(f"; {end}")


def test_other_commands_are_looked_into_only_if_no_flag_is_close() -> None:
    def others() -> dict[str, argparse.ArgumentParser]:
        asked.append(1)
        return {"run": of_another}

    own, of_another = (argparse.ArgumentParser(add_help=False) for _ in range(2))
    own.add_argument("--budget")
    of_another.add_argument("--replicas")
    asked: list[int] = []
    unknown = "unrecognized arguments: "
    assert suggestion(f"{unknown}--budgt 3", own, others) == "; did you mean --budget?"
    assert not asked
    assert suggestion(f"{unknown}--replicas", own, others) == "; --replicas is of fide run"


@pytest.mark.parametrize("words", [(*FIT, "--xyzzy"), (*FIT, "extra"), ("xyzzy",)])
def test_nothing_is_suggested_that_is_not_close(
    words: tuple[object, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert fide(*words) == 2
    assert "did you mean" not in one_line(capsys)


@pytest.mark.parametrize(
    ("words", "end"),
    [
        (("run", "voronio"), "did you mean 'voronoi'?"),
        (("run", "voronoi", "--task-set", "cell=4"), "did you mean 'cells'?"),
    ],
)
def test_tasks_and_their_options(
    words: tuple[object, ...], end: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fide(*words) == 2
    assert one_line(capsys).rstrip().endswith(end)


@pytest.mark.parametrize(
    ("given", "instead"),
    [
        ((*FIT, "--optimizer", "cma"), "fide run scene.py:render --target target.png"),
        (
            ("fit", "target.png", "--command", "ls {out}", "--space", "s.toml"),
            "fide run --command 'ls {out}' --space s.toml --target target.png",
        ),
    ],
)
def test_another_optimizer_is_of_another_command(
    given: tuple[object, ...], instead: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fide(*given, *([] if "--optimizer" in given else ["--optimizer", "cma"])) == 2
    assert one_line(capsys).rstrip().endswith(f"another one: {instead} --optimizer cma")


@pytest.mark.usefixtures("target")
def test_the_command_that_is_named_does_it(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["run", "scene.py:render", "--target", "target.png", "--optimizer", "random"]
    assert fide(*words, "--budget", 3, "--out", "out") == 0
    assert "after 3 renders" in capsys.readouterr().out


def test_an_option_that_has_taken_the_target_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert fide("fit", "--value-range", 0, 10, "t.tif", "--renderer", "s.py:f") == 2
    assert "--value-range has taken 't.tif': write --value-range=0,10" in one_line(capsys)
