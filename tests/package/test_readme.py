"""What the README shows works as it is written there."""

from __future__ import annotations

import argparse
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fide_plugins.cli import module_of

README = Path(__file__).parents[2] / "README.md"


def code_blocks() -> list[str]:
    return re.findall(r"```python\n(.*?)```", README.read_text("utf-8"), re.DOTALL)


def test_the_readme_s_own_python_finds_the_disk(capsys: pytest.CaptureFixture[str]) -> None:
    code = code_blocks()[0]
    names: dict[str, object] = {}
    exec(compile(code, str(README), "exec"), names)
    *_, loss = capsys.readouterr().out.split()
    assert float(loss) < 1e-3
    assert len([line for line in code.splitlines() if line.strip()]) <= 15


def test_the_readme_begins_with_a_film_that_ends_at_its_target() -> None:
    front = README.read_text("utf-8").partition("## ")[0]
    (path,) = re.findall(r"!\[.*?\]\((.*?)\)", front)
    assert (README.parent / path).stat().st_size < 1e6
    with Image.open(README.parent / path) as film:
        frames = []
        for number in range(getattr(film, "n_frames", 1)):
            film.seek(number)
            frames.append(np.asarray(film.convert("RGB"), float) / 255)
    half = frames[0].shape[1] // 2
    errors = [np.mean((frame[:, :half] - frame[:, half:]) ** 2) for frame in frames]
    assert len(frames) > 10 and errors[-1] < 1e-3 < 0.01 < errors[0]


def run_block(number: int) -> dict[str, Any]:
    names: dict[str, Any] = {}
    exec(compile(code_blocks()[number], str(README), "exec"), names)
    return names


def test_the_readme_s_space_finds_the_integer_and_the_choice() -> None:
    best = run_block(1)["opt"].best
    assert (best.params["columns"], best.params["direction"]) == (6, "along")
    assert best.params["radius"] == pytest.approx(0.27, abs=0.01)


@pytest.mark.filterwarnings("ignore:the model of .* has learned nothing like")  # of 100 renders
def test_each_line_of_the_table_works(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import fide_plugins

    def learn(render: Any, space: Any, renders: int, out: str) -> Any:
        assert renders == 100_000
        return fide_plugins.learn(render, space, renders=100, size=16, passes=1, workers=1, out=out)

    monkeypatch.chdir(tmp_path)
    names = run_block(1)
    picture = names["render"]({"radius": 0.3, "columns": 5, "direction": "across"})
    names |= {"learn": learn, "picture": picture, "front": picture, "side": picture[:32]}
    names["mask"] = np.ones_like(picture)
    lines = re.findall(r"^\| .* \| `(.*)` \|$", README.read_text("utf-8"), re.MULTILINE)
    assert len(lines) == 6
    for line in lines:
        exec(line, names)
    assert names["opt"].best is None  # of the next picture


def test_each_command_is_one_of_the_program() -> None:
    lines = re.findall(r"^    fide (.*)$", README.read_text("utf-8"), re.MULTILINE)
    assert len(lines) >= 12
    for line in lines:
        name, *words = shlex.split(line, comments=True)
        parser = argparse.ArgumentParser()
        module_of(name).add_arguments(parser)
        parser.parse_args(words)


@pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
def test_the_readme_s_lines_for_optuna_work_as_they_stand() -> None:
    best = run_block(2)["study"].best_params
    assert best == pytest.approx({"x": 0.7, "y": 0.35}, abs=0.01)


def test_the_readme_s_lines_for_nevergrad_work_as_they_stand(
    capsys: pytest.CaptureFixture[str],
) -> None:
    run_block(3)
    printed = capsys.readouterr().out.strip().splitlines()[-1].strip("[]").split()
    assert [float(value) for value in printed] == pytest.approx([0.7, 0.35], abs=0.01)
