"""Scenes as Mitsuba reads them: the same files, the same scene, and no code of its own."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_tasks import scene_file, scene_xml
from fide_tasks.mitsuba_variant import in_variant

pytest.importorskip("mitsuba", reason="Mitsuba is not installed: pip install mitsuba")

LIT = '<sensor type="perspective"/><emitter type="constant"/>'
SHAPE = '<shape type="obj"><string name="filename" value="{}"/></shape>'


@pytest.fixture
def mi() -> Iterator[Any]:
    with in_variant("scalar_rgb") as module:
        yield module


def write(path: Path, body: str, root: str = "scene") -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text(f'<{root} version="3.0.0">{body}</{root.split()[0]}>')
    return path


def mesh(path: Path, faces: int) -> None:
    """A mesh that is known by how many triangles it has."""
    corners = "".join(f"v {i} 0 0\nv {i} 1 0\nv {i} 0 1\n" for i in range(faces))
    triangles = "".join(f"f {3 * i + 1} {3 * i + 2} {3 * i + 3}\n" for i in range(faces))
    path.write_text(corners + triangles)


@pytest.mark.parametrize(
    ("body", "included", "faces"),
    [
        (SHAPE.format("one.obj"), "", 1),
        ('<path value="sub"/>' + SHAPE.format("two.obj"), "", 2),
        ('<path value="sub"/><path value="more"/>' + SHAPE.format("two.obj"), "", 4),
        ('<include filename="sub/inc.xml"/>', SHAPE.format("one.obj"), 1),
        (
            '<default name="file" value="one.obj"/><include filename="sub/inc.xml"/>',
            '<default name="file" value="two.obj"/>' + SHAPE.format("$file"),
            1,
        ),
        ('<include filename="sub/inc.xml"/>', SHAPE.format("sub/two.obj"), 2),
        (
            '<default name="f" value="one.obj"/><default name="fi" value="sub/two.obj"/>'
            + SHAPE.format("$fi"),
            "",
            2,
        ),
        ('<include filename="sub/inc.xml"/>', '<path value="sub"/>' + SHAPE.format("one.obj"), 1),
        (SHAPE.format(r"\$.obj"), "", 3),
    ],
)
def test_the_file_is_the_one_that_mitsuba_finds(
    tmp_path: Path, mi: Any, body: str, included: str, faces: int
) -> None:
    write(tmp_path / "sub" / "inc.xml", included)
    (tmp_path / "more").mkdir()
    names = ("one.obj", "sub/two.obj", "$.obj", "more/two.obj")
    for i, name in enumerate(names):
        mesh(tmp_path / name, i + 1)
    path = write(tmp_path / "scene.xml", LIT + body)
    parts, _ = scene_file.load(mi, scene_file.checked_scene(path))
    assert parts["shape_0"].face_count() == faces
    (theirs,) = mi.load_file(str(path)).shapes()
    assert theirs.face_count() == faces


@pytest.mark.parametrize(
    "root", ['include filename="c.xml"', 'path value="sub"', 'default name="file" value="one.obj"']
)
def test_an_included_file_is_a_scene_or_an_object_as_for_mitsuba(
    tmp_path: Path, mi: Any, root: str
) -> None:
    """An <include> that stayed would be opened by Mitsuba, whatever file it names."""
    mesh(tmp_path / "one.obj", 1)
    write(tmp_path / "c.xml", SHAPE.format("one.obj"))
    (tmp_path / "sub").mkdir()
    write(tmp_path / "b.xml", "", root)
    path = write(tmp_path / "scene.xml", LIT + '<include filename="b.xml"/>')
    tag = root.split()[0]
    with pytest.raises(ValueError, match=f"root element is <{tag}>"):
        scene_xml.read(path)
    with pytest.raises(RuntimeError, match=f'unexpected attribute "version" in element <{tag}>'):
        mi.load_file(str(path))


BODY = """
<default name="size" value="2"/>
<bsdf type="twosided" id="wall">
  <include filename="sub/plain.xml" name="inside"/>
</bsdf>
<bsdf type="$kind" id="$size\\$" ><rgb name="reflectance" value="0.2, 0.4, 0.6"/></bsdf>
<include filename="sub/room.xml"/>
<shape type="cube"><ref id="wall"/><transform name="to_world">
  <scale value="$size"/><rotate x="1" angle="$size$size"/>
</transform></shape>
"""
ROOM = """
<default name="size" value="7"/>
<shape type="sphere" id="ball"><float name="radius" value="$size"/><ref id="2$"/></shape>
<emitter type="point"><point name="position" value="1 2 3"/>
  <spectrum name="intensity" value="5"/></emitter>
"""


def test_the_scene_is_the_one_that_mitsuba_reads(tmp_path: Path, mi: Any) -> None:
    path = write(tmp_path / "scene.xml", LIT + '<default name="kind" value="diffuse"/>' + BODY)
    write(tmp_path / "sub" / "room.xml", ROOM.replace('"2$"', '"2\\$"'))
    write(tmp_path / "sub" / "plain.xml", "", 'bsdf type="diffuse" id="gray" name="other"')
    config = mi.parser.ParserConfig("scalar_rgb")
    ours = mi.parser.parse_string(config, scene_xml.text(scene_xml.read(path)))
    theirs = mi.parser.parse_file(config, str(path))
    for state in (ours, theirs):
        mi.parser.transform_all(config, state)
    written = mi.parser.write_string(ours)
    assert written == mi.parser.write_string(theirs)
    assert all(word in written for word in ("sphere", "cube", "twosided", "diffuse", "point"))


def test_spectra_are_read_from_where_they_are(tmp_path: Path, mi: Any) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "red.spd").write_text("400 0\n600 0\n610 1\n800 1\n")
    body = '<bsdf type="diffuse" id="b"><spectrum name="reflectance" filename="{}"/></bsdf>'
    path = write(tmp_path / "scene.xml", LIT + body.format("sub/red.spd"))
    scene = mi.load_string(scene_xml.text(scene_xml.read(path)))
    assert scene is not None
    path = write(tmp_path / "scene.xml", LIT + body.format("red.spd"))
    with pytest.raises(FileNotFoundError, match=r"red\.spd"):
        scene_xml.read(path)


def no_library(folder: Path, name: str) -> None:
    """A plugin that Mitsuba finds there and fails to load, since it is no library."""
    folder.mkdir(parents=True, exist_ok=True)
    for suffix in ("so", "dylib", "dll"):
        (folder / f"{name}.{suffix}").write_text("no library")


@pytest.mark.parametrize("started_in", [".", "scene"])
@pytest.mark.parametrize("folder", [".", "sub"], ids=["scene", "path"])
def test_no_code_of_a_scene_is_run(
    tmp_path: Path, mi: Any, folder: str, started_in: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    no_library(tmp_path / "scene" / folder / "plugins", "court")
    body = f'<path value="{folder}"/>' + LIT + '<shape type="court"/>'
    path = write(tmp_path / "scene" / "scene.xml", body)
    monkeypatch.chdir(tmp_path / started_in)
    with pytest.raises(RuntimeError, match="Error while loading plugin .*court"):
        mi.load_file(str(path))
    with pytest.raises(ValueError, match="it has no shape of type 'court'"):
        scene_file.load(mi, path)


def test_an_integrator_of_its_own_is_left_out(tmp_path: Path, mi: Any) -> None:
    body = LIT + '<integrator type="ours"><integer name="depth" value="3"/></integrator>'
    path = write(tmp_path / "scene.xml", body + '<shape type="cube"/>')
    parts, _ = scene_file.load(mi, path)
    assert "shape_0" in parts


def test_no_code_beside_a_scene_is_run_where_it_is_rendered(tmp_path: Path) -> None:
    """Of the plugins that every frame needs, Mitsuba's own are taken, wherever one starts it."""
    for name in ("hdrfilm", "box", "independent", "path", "direct", "perspective", "cube"):
        no_library(tmp_path / "plugins", name)
    path = write(tmp_path / "scene.xml", LIT + '<shape type="cube"/>')
    script = (
        f"import sys; sys.path[:0] = {[p for p in sys.path if p]}\n"
        "import mitsuba, fide_tasks\n"
        f"task = fide_tasks.make('san_miguel', 8, spp=1, variant='scalar', scene={str(path)!r})\n"
        "task.render([[0.5] * 8])\n"
        "print(str(mitsuba.file_resolver()[0]))\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, cwd=tmp_path, timeout=240
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == str(tmp_path), "where Mitsuba itself would look first, as before"


@pytest.mark.parametrize("size", [(160, 90), (90, 160), (50, 50)])
@pytest.mark.parametrize("axis", ["x", "y", "diagonal", "larger"])
def test_the_field_of_view_is_kept(
    tmp_path: Path, mi: Any, size: tuple[int, int], axis: str
) -> None:
    width, height = size
    sensor = (
        f'<sensor type="perspective"><string name="fov_axis" value="{axis}"/>'
        '<float name="fov" value="40"/><film type="hdrfilm">'
        f'<integer name="width" value="{width}"/><integer name="height" value="{height}"/>'
        "</film></sensor>"
    )
    body = sensor + '<emitter type="constant"/><shape type="cube"/>'
    path = write(tmp_path / "scene.xml", body)
    _, fov = scene_file.load(mi, path)
    film = {"type": "hdrfilm", "width": width, "height": height}
    ours = mi.load_dict({"type": "perspective", "fov": fov, "fov_axis": "smaller", "film": film})
    theirs = mi.load_file(str(path)).sensors()[0]
    x_fovs = [float(np.ravel(mi.traverse(one)["x_fov"])[0]) for one in (ours, theirs)]
    assert x_fovs[0] == pytest.approx(x_fovs[1], abs=1e-3)
