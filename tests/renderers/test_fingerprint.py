"""A renderer is known again by its source, where there is one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fide_plugins.renderers.fingerprint import fingerprint_of

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
