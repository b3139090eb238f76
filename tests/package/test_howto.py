"""Every page of docs/howto and docs/start begins with its answer, and its code runs as it stands.

Blocks run in the order of the page, in one folder.  A block whose first line is ``# NAME.py`` or
``# NAME.toml`` is that file.  Cells of notebooks run; one that is a file is written as well.  Pages
that import `scene` get the one of "Fit my own function".  A comment ``<!-- not run: reason -->``
before a block leaves it out, but for its syntax.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from PIL import Image

from fide_plugins.cli import main, module_of

DOCS = Path(__file__).parents[2] / "docs"
PAGES = sorted(p for part in ("howto", "start") for p in (DOCS / part).glob("*.md"))
HOWTO = [p for p in PAGES if p.parent.name == "howto" and p.stem != "index"]
LONGEST = 15  # lines of code of a block
TRUTH = {"x": 0.7, "y": 0.35, "radius": 0.2}


class Block(NamedTuple):
    language: str
    code: str
    runs: bool

    @property
    def file(self) -> str | None:
        """Name of the file that the block is."""
        found = re.match(r"# ([\w-]+\.(?:py|toml))$", self.code.partition("\n")[0])
        return found[1] if found else None


def blocks_of(page: Path) -> list[Block]:
    pattern = (
        r"(<!-- not run: .*? -->\n)?```(python|shell|toml|\{code-cell\})\n(?::[^\n]*\n)*(.*?)```"
    )
    found = re.findall(pattern, page.read_text("utf-8"), re.DOTALL)
    return [Block(language, code, not excused) for excused, language, code in found]


def command_lines(block: Block) -> Iterator[list[str]]:
    for line in block.code.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if words:
            yield words


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Current folder, from which modules can be imported, with some pictures in it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    tools = Path(sys.executable).parent
    monkeypatch.setenv("PATH", f"{tools}{os.pathsep}{os.environ['PATH']}")
    _forget_modules(tmp_path.parent)
    yield tmp_path
    _forget_modules(tmp_path.parent)


def _forget_modules(folder: Path) -> None:
    """Those of this test and of others, which have a `scene` of their own."""
    for name, module in list(sys.modules.items()):
        if str(folder) in str(getattr(module, "__file__", "")):
            del sys.modules[name]


def prepare(page: Path, folder: Path) -> None:
    """What a page takes for granted: the scene of the first page, and pictures of it."""
    (scene,) = [b for b in blocks_of(DOCS / "howto" / "function.md") if b.file == "scene.py"]
    if page.stem not in ("program", "shader"):
        (folder / "scene.py").write_text(scene.code, "utf-8")
    names: dict[str, Any] = {}
    exec(compile(scene.code, "scene.py", "exec"), names)
    image = np.repeat(names["render"](TRUTH)[..., None], 3, axis=-1)
    for name in ("target", "photo"):
        Image.fromarray((255 * image).astype(np.uint8)).save(folder / f"{name}.png")


def run(page: Path) -> dict[str, Any]:
    """Run a page; returns what its Python has defined."""
    names: dict[str, Any] = {"__name__": "__main__"}
    for block in blocks_of(page):
        is_cell = block.language == "{code-cell}"
        if block.file is not None and block.runs:
            Path(block.file).write_text(block.code, "utf-8")
        if is_cell or (block.language == "python" and block.file is None):
            code = compile(block.code, str(page), "exec")
            if block.runs:
                exec(code, names)
        elif block.language == "shell":
            for words in command_lines(block):
                check_arguments(words)
                if block.runs:
                    execute(words)
    return names


def check_arguments(words: list[str]) -> None:
    if words[0] == "fide":
        parser = argparse.ArgumentParser()
        module_of(words[1]).add_arguments(parser)
        parser.parse_args(words[2:])


def execute(words: list[str]) -> None:
    if words[0] == "fide":
        assert main(words[1:]) == 0, words
    else:
        assert words[0] == "python", words
        subprocess.run([sys.executable, *words[1:]], check=True)


def found(names: dict[str, Any]) -> bool:
    """Whether the result is the scene's own parameters, as far as an easy scene allows."""
    return close(names["result"].params, TRUTH)


def close(params: dict[str, float], truth: dict[str, float]) -> bool:
    return all(abs(params[name] - value) < 0.05 * max(1, value) for name, value in truth.items())


CHECKS: dict[str, Callable[[dict[str, Any]], object]] = {
    "answers": lambda names: found(names) and names["result"].solutions,
    "budget": lambda names: names["result"].stopped in ("stop_at", "solved"),
    "function": found,
    "gpu": lambda names: str(names["result"].optimizer.encoder.device) in ("cpu", "cuda:0"),
    "inside": lambda names: close(names["opt"].best.params, names["moved"]),
    "index": lambda names: "result" not in names or names["result"].best.loss < 1e-3,
    "learn_once": lambda names: names["model"].sample(names["target"], 3).shape == (3, 3),
    "nevergrad": lambda names: names["optimizer"].num_images == 200,
    "noise": lambda names: names["result"].optimizer.recommend().shape == (3,),
    "optuna": lambda names: names["study"].best_value < 0.01,
    "photo": lambda names: abs(names["result"].params["x"] - 0.6) < 0.05,
    "preset": found,
    "renderer": lambda names: close(names["result"].params, names["truth"]),
    "resume": lambda names: names["result"].evaluations > 20 and names["opt"].dim == 3,
    "shader": lambda names: names["result"].best.loss < 0.05,
    "stalled": lambda names: names["error"][:8].mean() > 0.1,
    "video": lambda names: names["opt"].best.loss <= 1e-4,
    "workers": lambda names: names["result"].stopped in ("solved", "budget"),
}
"""What a page must have found; the others must only run."""


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
@pytest.mark.filterwarnings("ignore:the model of .* has learned nothing like")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: f"{page.parent.name}-{page.stem}")
def test_the_code_of_the_page_runs(page: Path, folder: Path) -> None:
    if page.stem == "shader":
        pytest.importorskip("moderngl")
    prepare(page, folder)
    names = run(page)
    check = CHECKS.get(page.stem)
    assert check is None or check(names)


@pytest.mark.parametrize("page", HOWTO, ids=lambda page: page.stem)
def test_the_page_begins_with_its_answer(page: Path) -> None:
    title, _, first, *_ = page.read_text("utf-8").split("\n")
    assert title.startswith("# ") and first.startswith("**")


@pytest.mark.parametrize("page", HOWTO, ids=lambda page: page.stem)
def test_blocks_are_short(page: Path) -> None:
    blocks = blocks_of(page)
    assert blocks, "a page without code answers no how-to"
    for block in blocks:
        lines = [line for line in block.code.splitlines() if line.strip() and line[0] != "#"]
        assert len(lines) <= LONGEST, block.code
        assert max(map(len, lines)) <= 140, block.code


def test_every_page_is_on_the_front_page_of_its_part() -> None:
    listed = (DOCS / "howto" / "index.md").read_text("utf-8")
    assert [p.stem for p in HOWTO if f"({p.name})" not in listed] == []
