"""`fide fit` of pictures whose values are beyond [0, 1], hidden by a mask, or made smaller."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fide_plugins import FIDE
from fide_plugins.cli.fit_inputs import pictures, value_range_of
from fide_plugins.errors import OptionError
from fide_plugins.validation.images import save

from .conftest import fide

pytestmark = pytest.mark.usefixtures("empty_folder")

SCENE = """
import numpy as np
from fide_plugins import Float, Space
space = Space(x=Float(0, 1), y=Float(0, 1))
def render(p, h=12, w=16):
    v, u = np.mgrid[0:h, 0:w]
    d = (u / w - p["x"]) ** 2 + (v / h - p["y"]) ** 2
    return np.exp(-d / 0.05).astype(np.float32)
def field(p):
    return 10 * render(p) - 3
def bright(p):
    return 250 * render(p)
"""


@pytest.fixture
def scene() -> Any:
    Path("scene.py").write_text(SCENE)
    names: dict[str, Any] = {}
    exec(compile(SCENE, "scene", "exec"), names)
    return names


def fitted(*words: object) -> int:
    return fide("fit", *words, "--workers", 0, "--budget", 12, "--json", "--out", "out")


def summary(capsys: pytest.CaptureFixture[str]) -> Any:
    return json.loads(capsys.readouterr().out.splitlines()[-1])


@pytest.mark.parametrize("wild", [np.nan, -1, 2.0**20])
@pytest.mark.parametrize("option", ["--mask", "--weights"])
def test_hidden_values_are_those_of_python(
    wild: float, option: str, scene: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    target, mask = scene["render"]({"x": 0.5, "y": 0.5}), np.full((12, 16), 255, np.uint8)
    mask[:, :4] = 0
    target[:, :4] = wild
    Image.fromarray(target).save("t.tif")
    Image.fromarray(mask).save("m.png")
    assert fitted("t.tif", option, "m.png", "--renderer", "scene.py:render", "--seed", 0) == 0
    opt = FIDE(scene["space"], target, mask=mask, seed=0)
    losses = []
    for _ in range(12):
        x = opt.ask(1)
        losses += opt.tell(x, [scene["render"](opt.space.decode(x[0]))]).tolist()  # type: ignore[union-attr]
    assert summary(capsys)["best_loss"] == pytest.approx(min(losses), rel=1e-6)
    assert fitted("t.tif", "--renderer", "scene.py:render") == 2
    assert "the target must" in capsys.readouterr().err


def test_what_is_hidden_does_not_leak_into_a_smaller_picture(scene: Any) -> None:
    """Loss 0 at the right parameters, whatever the gaps of a detector hold."""
    small = scene["render"]({"x": 0.4, "y": 0.6})
    whole = np.kron(small, np.ones((4, 4), np.float32))
    mask = np.full(whole.shape, 255, np.uint8)
    mask[9:11], mask[:, 30:33], mask[:8, :8] = 0, 0, 0
    for wild in (0.0, 1.0, np.nan, 2.0**20):
        Image.fromarray(np.where(mask > 0, whole, np.float32(wild))).save("t.tif")
        Image.fromarray(mask).save("m.png")
        for options in (("m.png", None), (None, "m.png"), ("m.png", "m.png")):
            given = [None if one is None else [one] for one in options]
            (target,), (weights,) = pictures(["t.tif"], 16, *given)
            opt = FIDE(2, target, weights=weights)
            assert opt.tell(opt.ask(1), [small])[0] < 1e-12
            hidden = opt.weights == 0
            assert hidden[:2, :2].all() and hidden.sum() == 4


@pytest.mark.parametrize("given", [["-3", "7"], ["auto"]])
def test_a_range_of_values(
    given: list[str], scene: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    save("t.tif", scene["field"]({"x": 0.5, "y": 0.5}))
    words = ["--renderer", "scene.py:field", "--value-range", *given]
    assert fitted("t.tif", *words) == 0
    out = capsys.readouterr()
    assert json.loads(out.out.splitlines()[-1])["clipped"] == 0
    assert out.err.count("value range -7.99") == (given == ["auto"])
    run = json.loads(Path("out", "run.json").read_text())
    assert Path("out", "best.tif").exists() and len(run["settings"]["value_range"]) == 2
    assert fitted("t.tif", "--renderer", "scene.py:field", "--value-range", -3, 8, "--resume") == 2
    assert "value_range is" in capsys.readouterr().err


def test_renders_on_another_scale(scene: Any, capsys: pytest.CaptureFixture[str]) -> None:
    save("t.tif", scene["render"]({"x": 0.5, "y": 0.5}))
    assert fitted("t.tif", "--renderer", "scene.py:bright") == 2
    assert "another scale than the target" in capsys.readouterr().err


def test_what_the_shell_says_is_a_range() -> None:
    assert value_range_of(None) is None and value_range_of(["auto"]) == "auto"
    assert value_range_of(["-1,1"]) == value_range_of(["-1", "1"]) == (-1.0, 1.0)
    for words in (["1"], ["low", "high"], ["0", "1", "t.tif"]):
        with pytest.raises(OptionError, match="--value-range is two numbers"):
            value_range_of(words)
