"""``fide run`` on each of the tasks that need a renderer of their own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import fide_tasks
from fide_plugins.cli import main

pytestmark = pytest.mark.figures


@pytest.mark.parametrize(
    ("name", "fidelity", "renderer"),
    [
        ("robot", [], None),
        ("san_miguel", ["--spp", "1", "--task-set", "reference_spp=4"], "scalar_rgb"),
        ("beads", ["--spp", "1", "--task-set", "reference_spp=4"], "scalar_rgb"),
    ],
)
def test_each_scene_runs_and_says_what_rendered_it(
    name: str,
    fidelity: list[str],
    renderer: str | None,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if renderer is None:
        try:
            fide_tasks.make(name, 8).check()
        except (ImportError, RuntimeError) as error:
            pytest.skip(str(error))
    else:
        pytest.importorskip("mitsuba", reason="Mitsuba is not installed (extra mitsuba)")
        fidelity = [*fidelity, "--task-set", "variant=scalar"]
    words = ["run", name, "--optimizer", "cma", "--size", "12", "--budget", "6", *fidelity]
    assert main([*words, "--json", "--out", str(tmp_path)]) == 0
    printed = json.loads(capsys.readouterr().out.splitlines()[-1])
    run = json.loads((tmp_path / "run.json").read_text())
    assert (run["state"], run["settings"]["task"]) == ("finished", name)
    assert run["settings"].get("renderer") == renderer
    assert len(printed["x_best"]) == {"robot": 7, "san_miguel": 8, "beads": 18}[name]
    losses = [
        float(row.split(",")[1]) for row in (tmp_path / "curve.csv").read_text().splitlines()[1:]
    ]
    assert len(losses) == 6
    assert printed["best_loss"] == min(losses)
    made = {
        "best.png",
        "summary.png",
        "target.png",
        "run.ckpt",
        *(["reference.png"] if renderer else []),
    }
    assert made <= {path.name for path in tmp_path.iterdir()}
