"""The add-on: its zip is installed into a headless Blender, where it finds the place of a lamp."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path
from zipfile import ZipFile

import pytest

ROOT = Path(__file__).parents[3]
ADDON = ROOT / "adapters/blender_addon/fide_fit"
pytestmark = pytest.mark.skipif(not ADDON.exists(), reason="an installed copy has no add-on")


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """The zip, made as `make addon` makes it."""
    path = tmp_path / "fide_fit.zip"
    with ZipFile(path, "w") as file:
        for name in ("__init__.py", "blender_manifest.toml", "render.py"):
            file.write(ADDON / name, name)
    return path


def test_the_manifest_has_what_blender_requires() -> None:
    manifest = tomllib.loads((ADDON / "blender_manifest.toml").read_text("utf-8"))
    required = {"schema_version", "id", "version", "name", "tagline", "maintainer", "type"}
    assert required | {"blender_version_min", "license"} <= manifest.keys()
    assert len(manifest["tagline"]) <= 64 and manifest["tagline"][-1].isalnum()


@pytest.mark.slow
@pytest.mark.skipif(find_spec("bpy") is None, reason="needs Blender's module: pip install bpy")
def test_headless_blender_installs_the_zip_and_fits(archive: Path, tmp_path: Path) -> None:
    script = Path(__file__).with_name("headless.py")
    words = [sys.executable, str(script), str(archive), str(tmp_path)]
    user = {"BLENDER_USER_RESOURCES": str(tmp_path / "user")}
    done = subprocess.run(
        [*words, f"{sys.executable} -m fide_plugins"],
        env=os.environ | user, capture_output=True, text=True, timeout=280, check=False,
    )  # fmt: skip
    found = re.search(r"^found (.*)$", done.stdout, re.MULTILINE)
    assert found is not None, done.stdout + done.stderr
    assert "status Loss" in done.stdout and abs(float(found[1]) - 2) < 1.5, done.stdout
