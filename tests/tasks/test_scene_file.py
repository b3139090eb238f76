"""What a scene file must be, told before Mitsuba sees it; needs no Mitsuba."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from fide_tasks.scene_file import checked_scene

SENSOR = '<sensor type="perspective"/>'
EMITTER = '<emitter type="constant"/>'


def xml(folder: Path, body: str, name: str = "scene.xml") -> Path:
    path = folder / name
    path.write_text(f'<scene version="3.0.0">{body}</scene>')
    return path


def test_scenes_and_meshes_are_taken_by_their_absolute_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    xml(tmp_path, SENSOR + EMITTER)
    (tmp_path / "court.OBJ").touch()
    monkeypatch.chdir(tmp_path)
    assert checked_scene("scene.xml") == tmp_path.resolve() / "scene.xml"
    assert checked_scene(Path("court.OBJ")) == tmp_path.resolve() / "court.OBJ"


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=re.escape(str(tmp_path / "no.xml"))):
        checked_scene(tmp_path / "no.xml")
    with pytest.raises(FileNotFoundError, match="there is no scene file"):
        checked_scene(tmp_path / "no.obj")


@pytest.mark.parametrize("name", ["court.blend", "court", "court.xml.gz"])
def test_other_kinds_of_file_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match=r"a file of type \.xml, \.obj, \.ply, not '.*court"):
        checked_scene(tmp_path / name)


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("", "not well-formed XML: no element found"),
        ("<scene><sensor></scene>", "not well-formed XML: mismatched tag"),
        ("<robot/>", "not a Mitsuba scene: its root element is <robot>"),
        (f"<scene>{EMITTER}</scene>", "has no sensor: add a <sensor> element"),
        (f"<scene>{SENSOR}</scene>", "has no emitter: add a <emitter> element"),
    ],
)
def test_a_scene_that_lacks_something_is_named(tmp_path: Path, text: str, rule: str) -> None:
    path = tmp_path / "scene.xml"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"{re.escape(repr(str(path)))}.*{rule}"):
        checked_scene(path)


def test_a_scene_that_includes_itself_is_refused(tmp_path: Path) -> None:
    path = xml(tmp_path, SENSOR + EMITTER + '<include filename="a.xml"/>')
    xml(tmp_path, '<include filename="scene.xml"/>', "a.xml")
    with pytest.raises(ValueError, match="includes .*scene.xml' in itself"):
        checked_scene(path)


@pytest.mark.parametrize(
    "body",
    [
        '<shape type="obj"><string name="filename" value="{}"/></shape>',
        '<texture type="bitmap"><string name="filename" value="{}"/></texture>',
        '<spectrum name="reflectance" filename="{}"/>',
        '<include filename="{}"/>',
        '<path value="{}"/>',
        '<default name="f" value="{}"/><shape><string name="filename" value="$f"/></shape>',
    ],
)
def test_files_outside_the_folder_are_refused(tmp_path: Path, body: str) -> None:
    folder = tmp_path / "scene"
    folder.mkdir()
    secret = xml(tmp_path, SENSOR, "secret.xml")
    (folder / "link.xml").symlink_to(secret)
    for name in ("../secret.xml", str(secret), "link.xml"):
        path = xml(folder, SENSOR + EMITTER + body.format(name))
        with pytest.raises(ValueError, match="outside its folder; put the scene and all its files"):
            checked_scene(path)


def test_a_missing_mesh_is_named(tmp_path: Path) -> None:
    shape = '<shape type="obj"><string name="filename" value="meshes/wall.obj"/></shape>'
    path = xml(tmp_path, SENSOR + EMITTER + shape)
    with pytest.raises(FileNotFoundError, match=r"needs '.*wall\.obj', which is missing"):
        checked_scene(path)
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "wall.obj").touch()
    assert checked_scene(path) == path


SHAPE = '<shape type="obj"><string name="filename" value="{}"/></shape>'


@pytest.mark.parametrize(
    ("body", "included"),
    [
        ('<default name="f" value="{secret}"/><default name="f" value="in.obj"/>' + SHAPE, ""),
        ('<include filename="sub/inc.xml"/>', SHAPE.format("../secret.obj")),
        (
            '<default name="f" value="{secret}"/><include filename="sub/inc.xml"/>',
            '<default name="f" value="in.obj"/>' + SHAPE.format("$f"),
        ),
        (
            '<default name="n" value="filename"/>'
            '<shape type="obj"><string name="$n" value="{secret}"/></shape>',
            "",
        ),
        ('<path value=".."/>' + SHAPE.format("secret.obj"), ""),
        ('<bsdf type="conductor"><string name="material" value="../../up"/></bsdf>', ""),
    ],
    ids=["default", "include", "parameter", "attribute", "path", "material"],
)
def test_names_lead_where_mitsuba_finds_them(tmp_path: Path, body: str, included: str) -> None:
    """Each scene names a file outside its folder by Mitsuba's rules, and one inside by others."""
    folder, secret = tmp_path / "scene", tmp_path / "secret.obj"
    (folder / "sub").mkdir(parents=True)
    for path in (secret, folder / "secret.obj", folder / "in.obj"):
        path.touch()
    xml(folder / "sub", included, "inc.xml")
    body = body.replace("{secret}", str(secret)).replace("{}", "$f")
    with pytest.raises(ValueError, match="outside its folder; put the scene and all its files"):
        checked_scene(xml(folder, SENSOR + EMITTER + body))


@pytest.mark.parametrize("root", ["include", "path", "default"])
def test_no_element_that_mitsuba_would_resolve_is_left(tmp_path: Path, root: str) -> None:
    """Of an included file it stands in the place of the <include>."""
    (tmp_path / "sub").mkdir()
    xml(tmp_path, "", "c.xml")
    attributes = 'filename="c.xml"' if root == "include" else 'name="n" value="sub"'
    (tmp_path / "b.xml").write_text(f'<{root} version="3.0.0" {attributes}/>')
    path = xml(tmp_path, SENSOR + EMITTER + '<include filename="b.xml"/>')
    with pytest.raises(ValueError, match=f"root element is <{root}>; make <scene> its root"):
        checked_scene(path)


@pytest.mark.parametrize("kind", ["../court", "/tmp/court", "sub/court", "court.v2", "c\\court"])
def test_types_that_are_paths_are_refused(tmp_path: Path, kind: str) -> None:
    path = xml(tmp_path, SENSOR + EMITTER + f'<shape type="{kind}"/>')
    with pytest.raises(ValueError, match=f"{re.escape(repr(kind))}, which is no name of a plugin"):
        checked_scene(path)


def test_parameters_must_be_set_first(tmp_path: Path) -> None:
    body = '<shape type="$kind"/><default name="kind" value="cube"/>'
    with pytest.raises(ValueError, match=r"the parameter \$kind before .* add <default name="):
        checked_scene(xml(tmp_path, SENSOR + EMITTER + body))


def test_versions_are_not_mixed(tmp_path: Path) -> None:
    (tmp_path / "old.xml").write_text('<scene version="0.6.0"/>')
    path = xml(tmp_path, SENSOR + EMITTER + '<include filename="old.xml"/>')
    with pytest.raises(ValueError, match="other names .versions before 2.0 and later ones"):
        checked_scene(path)
