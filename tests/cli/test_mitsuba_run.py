"""``fide run`` on a task with noise and fidelity."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fide_plugins.cli import doctor_command, main
from fide_tasks import mitsuba_variant

pytest.importorskip("mitsuba", reason="Mitsuba is not installed: pip install mitsuba")

WORDS = ["run", "beads", "--optimizer", "cma", "--size", "16", "--budget", "8", "--json"]
WORDS += ["--task-set", "reference_spp=16"]


def test_spp_has_a_flag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "a")
    assert main([*WORDS, "--spp", "2", "--out", out]) == 0
    printed = capsys.readouterr()
    first = json.loads(printed.out.splitlines()[-1])
    run = json.loads((tmp_path / "a" / "run.json").read_text())
    assert run["settings"]["task_options"] == {"reference_spp": 16, "spp": 2}
    assert run["totals"]["mse"] == run["totals"]["reference_loss"] != first["best_loss"]
    assert (tmp_path / "a" / "reference.png").exists()


def test_doctor_says_which_variants_run(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    problems = {"cuda": "there is no driver", "llvm": "it aborts the process", "scalar": None}
    monkeypatch.setattr(mitsuba_variant, "problem_with", problems.get)
    facts = doctor_command._try_mitsuba()
    assert facts["scalar_rgb"] == "ok"
    assert facts["llvm_ad_rgb"].startswith("no: it aborts the process; install a recent LLVM")
    assert "libllvm19" in facts["llvm_ad_rgb"]
    monkeypatch.setattr(mitsuba_variant, "problem_with", lambda short: "Mitsuba is not installed")
    assert doctor_command._try_mitsuba() == {"mitsuba": "not installed: pip install mitsuba"}
    monkeypatch.undo()
    assert main(["doctor", "--verbose"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.split()[:2] == ["scalar_rgb", "ok"] for line in lines)
    assert any(line.split() == ["beads", "ok"] for line in lines)
