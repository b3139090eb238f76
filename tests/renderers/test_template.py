"""A program that cannot be run is named with what keeps it from that."""

from __future__ import annotations

from pathlib import Path

import pytest

from fide_plugins import Float, Space
from fide_plugins.errors import OptionError
from fide_plugins.renderers.command import Template


@pytest.mark.parametrize(
    ("program", "message"),
    [
        ("./draw.sh", "'./draw.sh' is a file that may not be executed; allow it .chmod .x., or"),
        ("./draw", "no program './draw' in the folder; install it"),
        ("./folder", "no program './folder' in the folder; install it"),
        ("~/draw.sh", "no shell reads the command, so ~ is no folder in '~/draw.sh'; write the"),
    ],
)
def test_what_keeps_a_program_from_being_run(
    program: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("draw.sh").write_text("#!/bin/sh\n")
    Path("draw.sh").chmod(0o600)
    Path("folder").mkdir()
    with pytest.raises(OptionError, match=message):
        Template(f"{program} {{out}} {{gray}}", Space(gray=Float(0, 1)))
