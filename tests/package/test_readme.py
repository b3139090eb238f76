"""What the README shows works as it is written there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[2] / "README.md"


def test_the_readme_s_own_python_finds_the_disk(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text("utf-8"), re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(code, str(README), "exec"), names)
    *_, loss = capsys.readouterr().out.replace("]", " ").split()
    assert float(loss) < 1e-3
    assert len([line for line in code.splitlines() if line.strip()]) <= 15
