"""Factories by name, and fingerprints of renderers."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab.run.task import RendererTask
from fide_plugins import encoders
from fide_plugins.errors import DeviceError, OptionError, UnknownNameError
from fide_plugins.renderers import FunctionRenderer
from fide_plugins.runtime.registry import Registry, fingerprint_of, version_of


@pytest.mark.parametrize("name", ["thre", "", None, 3, []])
def test_an_unknown_name_lists_the_known(name: object) -> None:
    registry = Registry[int]("number")
    registry.register("three", lambda: 3)
    registry.register("one", lambda: 1)
    with pytest.raises(UnknownNameError, match=r"unknown number .*known are one, three") as error:
        registry.make(name)  # type: ignore[arg-type]
    assert isinstance(error.value, ValueError)
    assert ("did you mean 'three'" in str(error.value)) == (name == "thre")


def test_an_option_that_a_factory_does_not_have_is_named() -> None:
    registry = Registry[int]("number")
    registry.register("sum", lambda a, *, more=0, less=0: a + more - less)
    registry.register("any", lambda **options: len(options))
    registry.register("whole", int)  # a class of C, of which Python knows no parameters
    assert registry.make("sum", 1, more=2) == 3 and registry.make("any", more=2) == 1
    assert registry.make("whole", "7") == 7
    with pytest.raises(OptionError, match="number 'sum': .*'lees'; its options: more, less"):
        registry.make("sum", 1, lees=1)
    registry.register("former", lambda a, device="cpu", size=3: size)
    with pytest.raises(OptionError, match="'sise'; its options: device, size"):
        registry.make("former", 1, sise=3)
    with pytest.raises(OptionError, match="encoder 'dense': .*'foo'; its options: device"):
        encoders.make("dense", foo=3)


@pytest.mark.parametrize(
    ("name", "factory"), [("", int), ("a\n", int), (1, int), ("a", "no colon"), ("a", 3)]
)
def test_odd_registrations_are_refused(name: object, factory: object) -> None:
    with pytest.raises(OptionError, match="got"):
        Registry[int]("number").register(name, factory)  # type: ignore[arg-type]


def test_a_name_with_a_variant() -> None:
    registry = Registry[str]("cloth")
    registry.register("plain", lambda: "plain")
    registry.register("dyed", lambda *, variant="white", fold=False: f"{variant} {fold}")
    assert registry.make("dyed") == "white False"
    assert registry.make("dyed:red:ish", fold=True) == "red:ish True"
    assert registry.knows("dyed:red") and registry.knows("plain") and not registry.knows("red")
    with pytest.raises(OptionError, match="cloth 'plain:red': .*'variant'"):
        registry.make("plain:red")
    with pytest.raises(UnknownNameError, match="unknown cloth 'dye': .* did you mean 'dyed'"):
        registry.make("dye:red")
    with pytest.raises(OptionError, match="without a colon, .* got 'dyed:red'"):
        registry.register("dyed:red", lambda: "red")


def test_listing_imports_nothing_heavy() -> None:
    program = (
        "import sys; from fide_plugins import encoders, errors, images, losses; "
        "encoders.names(), losses.names(); "
        "losses.make('mse', [[0.0]]); "
        "print([m for m in ('torch', 'scipy', 'PIL', 'kornia', 'cv2') if m in sys.modules])"
    )
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60
    )
    assert run.stdout == "[]\n"


@pytest.mark.parametrize("device", ["tpu9", "cuda:99", "", 1.5, "meta:x"])
def test_an_absent_device(device: str) -> None:
    with pytest.raises(DeviceError, match="no device .*'auto' or 'cpu' works"):
        encoders.make("dense", device=device)


# -- renderer fingerprints -------------------------------------------------------------------------


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
