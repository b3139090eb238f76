"""Without matplotlib, which is an extra, everything but figures works."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fide_plugins import Float, Space, fit
from fide_plugins.cli import main
from fide_plugins.errors import DependencyError
from fide_plugins.runtime.plotting import new_figure

NAMES = r"pip install matplotlib \(or .* its extra plot: pip install 'fide-plugins\[plot\]'\)"
SCENE = """
import numpy as np
from fide_plugins import Float, Space
space = Space(gray=Float(0, 1))
def render(p):
    return np.full((8, 8), p["gray"])
"""


def draw(p: dict[str, float]) -> np.ndarray:
    return np.full((8, 8), p["gray"])


@pytest.fixture
def plain_install(monkeypatch: pytest.MonkeyPatch) -> None:
    """As after `pip install fide-plugins`."""
    for name in [*sys.modules, "matplotlib", "matplotlib.figure"]:
        if name.partition(".")[0] == "matplotlib":
            monkeypatch.setitem(sys.modules, name, None)
    for name in ("result_figure", "pairs_figure"):
        monkeypatch.delitem(sys.modules, f"fide_plugins.recording.{name}", raising=False)


@pytest.mark.figures
@pytest.mark.usefixtures("plain_install")
def test_a_fit_writes_all_but_its_figure(tmp_path: Path) -> None:
    with pytest.warns(RuntimeWarning, match=f"summary.png is left out: .* {NAMES}"):
        result = fit(draw, np.full((8, 8), 0.4), Space(gray=Float(0, 1)), budget=20, workers=0,
                     out=tmp_path / "run")  # fmt: skip
    files = {path.name for path in (tmp_path / "run").iterdir()}
    assert {"best.png", "target.png", "curve.csv", "run.json"} <= files
    assert "summary.png" not in files
    assert "losses" not in result._repr_html_() and "gray" in result._repr_html_()
    for plot in (result.plot, result.plot_pairs, lambda: new_figure(1, 1)):
        with pytest.raises(DependencyError, match=NAMES):
            plot()


@pytest.mark.figures
@pytest.mark.filterwarnings("default")
@pytest.mark.usefixtures("plain_install")
def test_commands_say_what_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plain_scene.py").write_text(SCENE)
    from fide_plugins.validation.images import save

    save("target.png", np.full((8, 8), 0.4, np.float32))
    words = "fit target.png --renderer plain_scene.py:render --workers 0 --budget 20 --out run"
    assert main(words.split()) == 0
    told = capsys.readouterr()
    assert "summary.png is left out: figures need matplotlib" in told.err
    assert "look at run/best.png" in told.out
    assert main(["check", "plain_scene.py:render", "--workers", "1", "--out", "check"]) == 0
    told = capsys.readouterr()
    assert "check.png is left out" in told.err and "look at" not in told.out
    assert main(["solutions", "run"]) == 0
    assert "solutions.png is left out" in capsys.readouterr().err
    assert main(["solutions", "run", "-o", "answers.png"]) == 2
    assert "extra plot" in capsys.readouterr().err


def test_a_fit_without_files_loads_no_matplotlib() -> None:
    code = (
        "import sys, numpy as np\n"
        "from fide_plugins import fit, Space, Float\n"
        "fit(lambda p: np.full((8, 8), p['g']), np.full((8, 8), 0.4), Space(g=Float(0, 1)),\n"
        "    budget=20, workers=0)\n"
        "assert 'matplotlib' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
