"""A program that writes an image: its command line, and all that can go wrong."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from fide_plugins import Choice, Fidelity, Float, Group, Space, fit
from fide_plugins.errors import OptionError, RenderError
from fide_plugins.renderers import CommandRenderer
from fide_plugins.renderers.command import Template

PROGRAM = """
import os, sys, time
mode, out, gray = sys.argv[1:4]
print("rendering", *sys.argv[4:], flush=True)
if mode == "fails":
    print("no light in the scene", file=sys.stderr)
    sys.exit(3)
if mode == "hangs":
    time.sleep(600)
if mode == "dies":
    os.kill(os.getpid(), 9)
if mode == "writes nothing":
    sys.exit()
if mode == "removes the folder":
    sys.exit(os.rmdir(os.path.dirname(out)))
if mode == "numbers its images":
    out = out.replace(".png", "0001.png")
if mode == "writes two":
    out = out.replace(".png", "0001.png")
    open(out.replace("0001", "0002"), "w").close()
image = b"P6 5 4 255\\n" + bytes([int(float(gray) * 255)] * 60)  # PPM, which has no checksums
open(out, "wb").write(b"this is no image" if mode == "writes no image" else image)
"""
"""A renderer that starts quickly: it needs no package."""

STARTS = """
import subprocess, sys
child = subprocess.Popen([sys.executable, "-I", "-S", "-c", "import time; time.sleep(600)"])
open("pid", "w").write(str(child.pid))
child.wait()
"""
"""A program that waits for another one, which hangs."""

SPACE = Space(gray=Float(0, 1), floor=Choice("a b", "$HOME; `id`", "--help"))


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "work").mkdir()
    (tmp_path / "tmp").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))


def template(mode: str = "works", rest: str = "{floor}") -> str:
    Path("program.py").write_text(PROGRAM)
    return f"{sys.executable} -I -S program.py '{mode}' {{out}} {{gray}} {rest}"


def params(gray: float = 0.2, floor: str = "a b") -> dict[str, object]:
    return {"gray": gray, "floor": floor}


def arguments(text: str, space: Space, values: Mapping[str, object]) -> list[str]:
    return Template(f"{sys.executable} {text}", space).command(values, "O.png", "P.json")[1:]


# -- the image -------------------------------------------------------------------------------------


def test_the_image_that_the_program_writes_is_read_and_nothing_is_left(tmp_path: Path) -> None:
    image = CommandRenderer(template(), SPACE)(params(gray=0.2))
    np.testing.assert_array_equal(image, np.full((4, 5, 3), np.float32(0.2)))
    assert os.listdir(tmp_path / "tmp") == []
    assert os.listdir() == ["program.py"]


def test_a_name_to_which_the_program_adds_a_number_is_found() -> None:
    image = CommandRenderer(template("numbers its images"), SPACE)(params())
    assert np.shape(image) == (4, 5, 3)


def test_another_ending_chooses_another_format() -> None:
    renderer = CommandRenderer(template().replace("{out}", "{out:.ppm}"), SPACE)
    np.testing.assert_array_equal(renderer(params(gray=1.0)), np.ones((4, 5, 3), np.float32))


def test_one_command_a_view_gives_a_list_of_images() -> None:
    front, side = template(), template(rest="side")
    images = CommandRenderer([front, side], SPACE)(params())
    assert isinstance(images, list) and len(images) == 2


@pytest.mark.parametrize("value", [np.nan, 1.25, -0.25])
def test_floats_are_read_as_a_render_and_not_as_a_target(value: float) -> None:
    """Where a mask hides it a render may be NaN; elsewhere what overshoots is clipped."""
    Path("floats.py").write_text(
        "import sys\nimport numpy as np\nfrom PIL import Image\n"
        f"image = np.full((4, 6), float(sys.argv[2]), 'f')\nimage[:, 3:] = float('{value}')\n"
        "Image.fromarray(image).save(sys.argv[1])\n"
    )
    space = Space(gray=Float(0, 1))
    render = CommandRenderer(f"{sys.executable} floats.py {{out:.tif}} {{gray}}", space)
    image = render({"gray": 0.5})
    expected = np.full((4, 6, 3), 0.5, np.float32)
    expected[:, 3:] = value
    np.testing.assert_array_equal(image, expected)
    mask = np.zeros((4, 6))
    mask[:, :3] = 1
    target = np.full((4, 6, 3), 0.5)
    result = fit(render, target, space, budget=3, workers=0, seed=0, mask=mask, progress=False)
    assert result.failures == 0
    if np.isfinite(value):
        with pytest.warns(RuntimeWarning, match="clipped"):
            result = fit(render, target, space, budget=3, workers=0, seed=0, progress=False)
        assert result.failures == 0


# -- the command line ------------------------------------------------------------------------------


def test_values_are_single_arguments_whatever_they_contain() -> None:
    for floor in ("a b", "$HOME; `id`", "--help"):
        assert arguments("x {floor} {out} {gray}", SPACE, params(floor=floor))[1] == floor
        assert (
            arguments("x=[{floor}] {out} {gray}", SPACE, params(floor=floor))[0] == f"x=[{floor}]"
        )


def test_formats_braces_quotes_and_pieces_of_arguments() -> None:
    text = "+O{out} 'A  {gray:.3f}' B={gray:.1e} {{gray}} {floor!r} {params}"
    assert arguments(text, SPACE, params(gray=0.12345)) == [
        "+OO.png", "A  0.123", "B=1.2e-01", "{gray}", "'a b'", "P.json",
    ]  # fmt: skip


def test_parameters_of_groups_by_their_flat_names() -> None:
    space = Space(ball=Group(x=Float(0, 1)), beads=2 * Group(y=Float(0, 1)))
    values = {"ball": {"x": 0.5}, "beads": [{"y": 0.25}, {"y": 0.75}]}
    text = "{out} {ball.x} {beads[0].y} {beads[1].y}"
    assert arguments(text, space, values)[1:] == ["0.5", "0.25", "0.75"]


def test_all_parameters_in_a_file() -> None:
    space = Space(beads=2 * Group(y=Float(0, 1)), gray=Float(0, 1))
    Path("read.py").write_text(
        "import json, sys\nparams = json.load(open(sys.argv[1]))\n"
        "gray = int(255 * params['beads'][1]['y'])\n"
        "open(sys.argv[2], 'wb').write(b'P5 2 2 255\\n' + bytes([gray] * 4))\n"
    )
    renderer = CommandRenderer(f"{sys.executable} -I -S read.py {{params}} {{out}}", space)
    image = renderer({"gray": 0.0, "beads": [{"y": 0.0}, {"y": 1.0}]})
    np.testing.assert_array_equal(image, np.ones((2, 2, 3), np.float32))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the command is empty"),
        ("ls 'a {out}", "cannot be read .No closing quotation.*quotes in pairs"),
        ("ls {out} {gray} {flor}", "{flor} in the command is no parameter.*did you mean {floor}"),
        ("ls {out} {gray", "cannot be read .*write {{ and }} for braces"),
        ("ls {out} {gray:{floor}} {floor}", "a placeholder inside another one"),
        ("ls {gray} {floor}", "has no {out}, so the image would not be found"),
        ("ls {out} {gray}", "'floor' of the space is nowhere in the command; write {floor}"),
        ("ls {out} {gray:d} {floor}", "{gray:d} in the command does not fit the value 0.5"),
        ("ls {out} {gray} {floor:.2f}", "does not fit the value 'a b'.*or write {floor}$"),
        ("ls {out} {gray} {floor} > log", "'>' would be an argument, because no shell"),
        ("no-such-program {out} {gray} {floor}", "no program 'no-such-program' that may be"),
    ],
)
def test_what_can_be_known_is_said_before_the_first_render(text: str, message: str) -> None:
    with pytest.raises(OptionError, match=message):
        CommandRenderer(text, SPACE)


def test_a_format_must_fit_every_value_of_a_choice() -> None:
    """The renders of the others would fail, and the fit would go on without these values."""
    balls = 2 * Group(n=Choice(1, 2, "auto"))
    with pytest.raises(OptionError, match=r"{balls\[1\].n:d} .* the value 'auto'"):
        CommandRenderer("ls {out} {balls[0].n} {balls[1].n:d}", Space(balls=balls))
    CommandRenderer("ls {out} {balls[0].n} {balls[1].n!s:>4}", Space(balls=balls))


def test_names_of_files_and_times_without_meaning_are_refused() -> None:
    with pytest.raises(OptionError, match="no parameter .* called 'out'.*call it out_"):
        CommandRenderer("ls {out}", Space(out=Float(0, 1)))
    with pytest.raises(OptionError, match="timeout must be a number of seconds > 0, not 0"):
        CommandRenderer(template(), SPACE, timeout=0)


# -- a program that fails --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mode", "messages"),
    [
        ("fails", ["ended with exit code 3", "rendering a b\nno light in the scene"]),
        ("dies", ["was ended by signal 9"]),
        ("writes nothing", ["wrote no image", "is {out} where it expects the name?"]),
        ("removes the folder", ["wrote no image"]),
        ("writes no image", ["wrote an image that cannot be read: cannot read 'out.png'"]),
        ("writes two", ["wrote several files, but not out.png: out0001.png, out0002.png"]),
    ],
)
def test_a_failure_names_command_parameters_and_output(
    mode: str, messages: list[str], tmp_path: Path
) -> None:
    with pytest.raises(RenderError) as caught:
        CommandRenderer(template(mode), SPACE)(params(gray=0.25))
    text = str(caught.value)
    for message in [*messages, "gray=0.25, floor=a b", "to see it, run:", "out.png 0.25 'a b'"]:
        assert message in text
    assert os.listdir(tmp_path / "tmp") == []
    assert str(pickle.loads(pickle.dumps(caught.value))) == text


def test_a_program_that_hangs_is_stopped_with_all_it_started(
    tmp_path: Path, ends: Callable[[int], bool]
) -> None:
    Path("starts.py").write_text(STARTS)
    text = f"{sys.executable} -I -S starts.py {{out}} {{gray}} {{floor}}"
    with pytest.raises(RenderError, match="did not end within 1 s; give it more time"):
        CommandRenderer(text, SPACE, timeout=1)(params())
    assert ends(int(Path("pid").read_text()))
    assert os.listdir(tmp_path / "tmp") == []


def test_a_worker_that_leads_a_group_stops_what_hangs_and_goes_on(
    ends: Callable[[int], bool],
) -> None:
    Path("starts.py").write_text(STARTS)
    text = f"{sys.executable} -I -S starts.py {{out}} {{gray}} {{floor}}"
    slow, quick = CommandRenderer(text, SPACE, timeout=1), CommandRenderer(template(), SPACE)
    with ProcessPoolExecutor(1, get_context("spawn"), os.setsid) as pool:
        with pytest.raises(RenderError, match="did not end within 1 s"):
            pool.submit(slow, params()).result(60)
        assert np.shape(pool.submit(quick, params()).result(60)) == (4, 5, 3)
    assert ends(int(Path("pid").read_text()))


def test_ctrl_c_stops_the_program_and_leaves_nothing(
    tmp_path: Path, ends: Callable[[int], bool]
) -> None:
    Path("pids.py").write_text(
        "import os, time\nopen('pid.new', 'w').write(str(os.getpid()))\n"
        "os.rename('pid.new', 'pid')\ntime.sleep(600)\n"
    )
    script = (
        "import sys, tempfile\n"
        "from fide_plugins import Float, Space\n"
        "from fide_plugins.renderers import CommandRenderer\n"
        f"tempfile.tempdir = {str(tmp_path / 'tmp')!r}\n"
        "text = sys.executable + ' -I -S pids.py {out} {gray}'\n"
        "CommandRenderer(text, Space(gray=Float(0, 1)))({'gray': 0.5})\n"
    )
    heard = partial(
        signal.signal, signal.SIGINT, signal.default_int_handler
    )  # background jobs ignore it
    child = subprocess.Popen(
        [sys.executable, "-c", script], stderr=subprocess.DEVNULL, preexec_fn=heard
    )
    until = time.monotonic() + 60
    while not Path("pid").exists() and time.monotonic() < until:
        time.sleep(0.02)
    child.send_signal(signal.SIGINT)
    assert child.wait(60) != 0
    assert ends(int(Path("pid").read_text()))
    assert os.listdir(tmp_path / "tmp") == []


def test_size_samples_and_seed_are_placeholders_unless_the_space_has_them(tmp_path: Path) -> None:
    program = tmp_path / "draw.py"
    program.write_text(
        "import sys\n"
        "out, gray, width, height, *more = sys.argv[1:]\n"
        "w, h = int(width), int(height)\n"
        "head, pixel = b'P6 %d %d 255\\n' % (w, h), bytes([int(float(gray))])\n"
        "open(out, 'wb').write(head + pixel * (3 * w * h))\n"
        "open(__file__ + '.log', 'a').write(' '.join([width, height, *more]) + '\\n')\n"
    )
    text = f"{sys.executable} -I -S {program} {{out}} {{gray}} {{width}} {{height}}"
    text += " {samples} {seed}"
    space = Space(gray=Float(0, 255), seed=Float(1, 2))
    render = CommandRenderer(text, space)
    assert sorted(render.keywords) == ["samples", "size"]
    image = render({"gray": 51.0, "seed": 1.5}, size=(4, 6), samples=3)
    assert np.shape(image) == (4, 6, 3) and np.allclose(image, 0.2)
    target = np.full((64, 64, 3), 0.2)
    small = Fidelity(size=(32, 64), samples=(1, 64))
    fit(render, target, space, 6, workers=0, seed=0, until="budget", fidelity=small)
    lines = (tmp_path / "draw.py.log").read_text().splitlines()
    assert lines[0] == "6 4 3 1.5"
    assert lines[1].startswith("32 32 1 1.") and lines[-1].startswith("64 64 64 ")
