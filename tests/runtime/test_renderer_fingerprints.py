"""A renderer is known again by the version that it states, or by its source, where there is one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab.run.task import RendererTask
from fide_plugins.errors import OptionError
from fide_plugins.renderers import FunctionRenderer
from fide_plugins.runtime.registry import fingerprint_of, version_of

CODE = "\n\ndef render(p):\n    return p\n"


def defined(file: Path, code: str) -> Any:
    names: dict[str, Any] = {}
    exec(compile(code, str(file), "exec"), names)
    return names["render"]


def test_the_same_source_is_the_same_renderer(tmp_path: Path) -> None:
    prints = []
    for name, code in (("a", CODE), ("b", CODE), ("c", CODE.replace("return p", "return 2 * p"))):
        file = tmp_path / f"{name}.py"
        file.write_text(code, "utf-8")
        prints.append(fingerprint_of(defined(file, code)))
    assert prints[0] == prints[1] != prints[2] and prints[0] is not None


def test_a_file_that_has_changed_since_says_nothing(tmp_path: Path) -> None:
    file = tmp_path / "scene.py"
    file.write_text("\n\ndef render(p: [\n", "utf-8")  # as in an editor, half written
    assert fingerprint_of(defined(file, CODE)) is None
    assert fingerprint_of(defined(tmp_path / "gone.py", CODE)) is None


def stated(version: object) -> Any:
    def render(params: object) -> None:
        """Nothing."""

    render.version = version  # type: ignore[attr-defined]
    return render


def test_a_version_is_a_text_that_the_renderer_states() -> None:
    class Program:
        """A class of one's own, with a method of that name."""

        def version(self) -> str:
            return "3.7"

    assert version_of(stated("2.1")) == "2.1"
    assert version_of(stated(None)) is None
    assert version_of(np.zeros_like) is None  # says nothing
    assert version_of(Program()) is None


@pytest.mark.parametrize("version", [2, 2.5, "", (1, 2), np])
def test_a_version_that_is_no_text_is_refused(version: object) -> None:
    with pytest.raises(OptionError, match=r"the version of render is a text such as '2', or None"):
        version_of(stated(version))


def test_a_version_passes_through_what_wraps_a_function(tmp_path: Path) -> None:
    file = tmp_path / "versioned_scene.py"
    file.write_text("def render(x):\n    return x\n\n\nrender.version = '7'\n", "utf-8")
    function = FunctionRenderer(f"{file}:render")
    assert version_of(function) == version_of(RendererTask("scene", function, 2)) == "7"
    assert version_of(RendererTask("scene", stated(None), 2)) is None
