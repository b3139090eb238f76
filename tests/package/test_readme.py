"""What the README shows works as it is written there."""

from __future__ import annotations

import argparse
import ast
import io
import re
import shlex
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fide_plugins.cli import module_of

README = Path(__file__).parents[2] / "README.md"


def code_blocks() -> list[str]:
    return re.findall(r"```python\n(.*?)```", README.read_text("utf-8"), re.DOTALL)


def words_before(text: str) -> int:
    return len(README.read_text("utf-8").partition(text)[0].split())


def test_the_readme_is_short_and_shows_python_early() -> None:
    assert words_before("\0") <= 800 and words_before("```python") < 250


def test_the_film_stands_still_at_its_end() -> None:
    front = README.read_text("utf-8").partition("## ")[0]
    (path,) = re.findall(r"!\[.*?\]\((.*?)\)", front)
    assert (README.parent / path).stat().st_size < 1e6
    frames = []
    with Image.open(README.parent / path) as film:
        for number in range(getattr(film, "n_frames", 1)):
            film.seek(number)
            image = np.asarray(film.convert("RGB"), float)[28:] / 255  # below the names
            frames.append(np.split(image, 3, axis=1))
    target, cma, fide = frames[0]
    error = np.mean((fide - target) ** 2)
    assert len(frames) > 50 and error < 1e-3 < np.mean((cma - target) ** 2)
    assert np.mean((frames[1][2] - frames[1][0]) ** 2) > 3e-3  # where FIDE began


@pytest.fixture(scope="module")
def after_python() -> dict[str, Any]:
    """Names after the first block of the README, and what it printed."""
    names: dict[str, Any] = {}
    printed = io.StringIO()
    with redirect_stdout(printed):
        exec(compile(code_blocks()[0], str(README), "exec"), names)
    return names | {"printed": printed.getvalue()}


def test_the_readme_s_own_python_finds_the_disk(after_python: dict[str, Any]) -> None:
    assert after_python["result"].best.loss < 1e-3
    shown = re.search(r"^    (\{'x'.*\})$", README.read_text("utf-8"), re.MULTILINE)
    assert shown is not None
    found, said = (ast.literal_eval(text) for text in (after_python["printed"], shown[1]))
    assert found == pytest.approx(said, abs=0.02)  # another processor ends elsewhere on the edge
    assert len([line for line in code_blocks()[0].splitlines() if line.strip()]) <= 12


def test_each_command_is_one_of_the_program() -> None:
    lines = re.findall(r"^    fide (.*)$", README.read_text("utf-8"), re.MULTILINE)
    assert len(lines) == 4
    for line in lines:
        name, *words = shlex.split(line, comments=True)
        parser = argparse.ArgumentParser()
        module_of(name).add_arguments(parser)
        parser.parse_args(words)


@pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
@pytest.mark.parametrize("number", [1, 2], ids=["optuna", "nevergrad"])
def test_the_plugins_work_as_they_stand(number: int, after_python: dict[str, Any]) -> None:
    names = dict(after_python)
    exec(compile(code_blocks()[number], str(README), "exec"), names)
    best = names["study"].best_params if number == 1 else names["found"].value
    error = np.mean((names["render"](best) - names["target"]) ** 2)
    assert error < 5e-3  # a random candidate: 0.1
