"""A comparison on disk: what a run is, what is kept, what is done again, what is refused."""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab import compare, optimizers, run as harness
from fide_lab.baselines.evolution import Random
from fide_lab.compare import Outcome, RunKey, driver as processes
from fide_lab.compare.driver import prepare
from fide_plugins.recording.storage import RunDirectoryError
from fide_plugins.runtime import files, machine

from .conftest import Raises, contents, small


def kinds(outcomes: list[Outcome]) -> dict[tuple[str, int], str]:
    return {(outcome.key.configuration, outcome.key.seed): outcome.kind for outcome in outcomes}


def losses_of(folder: Path) -> list[float]:
    lines = (folder / "curve.csv").read_text().splitlines()[1:]
    return [float(line.split(",")[1]) for line in lines]


def test_a_comparison_is_made_of_runs_and_everyone_has_the_same_target(tmp_path: Path) -> None:
    plan = small("cma", "cma:popsize=20:budget=30", options={"sigma0": 0.2})
    assert set(kinds(compare.run(plan, tmp_path)).values()) == {"done"}
    for key in plan.runs():
        extra = {"popsize": 20} if "=" in key.configuration else {}
        by_hand = harness.run(
            "voronoi", "cma", "mse", 30 if extra else 40, key.seed, size=16,
            task_options={"cells": 2}, options={"sigma0": 0.2, **extra},
        )  # fmt: skip
        assert losses_of(tmp_path / key.folder) == by_hand.losses.tolist()
        result = next(r for r in compare.read(tmp_path).runs if r.key == key)
        assert result.final == by_hand.reference_loss == by_hand.best_loss
        assert result.curve is not None
        best = np.minimum.accumulate(by_hand.losses)
        marks = np.arange(1, len(best) + 1)
        np.testing.assert_array_equal(result.curve.value("renders", marks), best)
        np.testing.assert_allclose(result.curve.value("renders", marks, "mse"), best, rtol=1e-6)
    runs = [json.loads(path.read_text()) for path in tmp_path.rglob("run.json")]
    assert len({run["settings"]["target"] for run in runs}) == 1


def test_what_is_finished_is_kept(tmp_path: Path) -> None:
    compare.run(small(), tmp_path)
    before = contents(tmp_path / "cells")
    assert set(kinds(compare.run(small(), tmp_path, resume=True)).values()) == {"kept"}
    assert contents(tmp_path / "cells") == before
    assert not any(name.endswith(".ckpt") for name in before)
    with pytest.raises(RunDirectoryError, match="already holds a comparison with these settings"):
        compare.run(small(), tmp_path)


def test_a_comparison_can_grow(tmp_path: Path) -> None:
    compare.run(small("cma"), tmp_path)
    bigger = small("cma", "random", seeds=3, losses=("mse", "loi"))
    outcomes = compare.run(bigger, tmp_path, resume=True)
    assert [outcome.kind for outcome in outcomes].count("kept") == 2
    assert len(compare.read(tmp_path).runs) == 12
    compare.run(small("cma"), tmp_path, resume=True)
    assert len(compare.read(tmp_path).runs) == 12, "what is there stays part of it"
    assert len(compare.read(tmp_path).calls) == 3


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("size", 24), ("budget", 50), ("task_seed", 1), ("task_options", {"cells": 3}),
        ("options", {"sigma0": 0.3}), ("metrics", ("mse",)),
    ],
)  # fmt: skip
def test_other_settings_are_never_mixed(setting: str, value: Any, tmp_path: Path) -> None:
    compare.run(small(seeds=1), tmp_path)
    before = contents(tmp_path)
    with pytest.raises(RunDirectoryError, match=f"a comparison with other settings: {setting} is"):
        compare.run(small(seeds=1, **{setting: value}), tmp_path, resume=True)
    assert contents(tmp_path) == before


def test_a_target_that_changed_is_another_comparison(tmp_path: Path) -> None:
    compare.run(small("cma", seeds=1), tmp_path)
    path = tmp_path / "study.json"
    study = json.loads(path.read_text())
    study["settings"]["targets"]["voronoi"] = "0"
    path.write_text(json.dumps(study))
    with pytest.raises(RunDirectoryError, match="on voronoi with .* the target is another"):
        compare.run(small("random", seeds=1), tmp_path, resume=True)


def test_a_run_in_the_place_of_another_is_refused(tmp_path: Path) -> None:
    compare.run(small(), tmp_path)
    cma = tmp_path / "cells" / "voronoi" / "mse" / "cma"
    shutil.rmtree(cma / "seed-1")
    shutil.copytree(cma / "seed-0", cma / "seed-1")
    with pytest.raises(RunDirectoryError, match="seed-1 holds a run with other.*seed is 0 there"):
        compare.run(small(), tmp_path, resume=True)
    moved = next(r for r in compare.read(tmp_path).runs if r.key.seed == 1)
    assert moved.state == "damaged" and "a run with other settings" in moved.why


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-9])


DAMAGE: dict[str, Any] = {
    "no record": lambda folder: (folder / "run.json").unlink(),
    "all but a picture removed": lambda folder: [
        file.unlink() for file in folder.iterdir() if file.suffix != ".png"
    ],
    "a table that was cut": lambda folder: _cut(folder / "improvements.csv"),
    "a table that was edited": lambda folder: (folder / "curve.csv").write_text(
        "evaluation,loss\n"
    ),
    "a table that is gone": lambda folder: (folder / "curve.csv").unlink(),
    "a record that was cut": lambda folder: _cut(folder / "run.json"),
    "a record of nothing": lambda folder: (folder / "run.json").write_text("[]"),
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a whole comparison, to be copied."""
    folder = tmp_path_factory.mktemp("finished")
    compare.run(small(), folder)
    return folder


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_runs_are_repeated_and_reported(
    damage: str, finished: Path, tmp_path: Path
) -> None:
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    key = RunKey("voronoi", "mse", "cma", 1)
    whole = losses_of(tmp_path / key.folder)
    DAMAGE[damage](tmp_path / key.folder)
    found = next(r for r in compare.read(tmp_path).runs if r.key == key)
    assert found.state == "damaged" and found.curve is None
    comparison = prepare(small(), tmp_path, resume=True)
    assert comparison.states[key].kind == "damaged"
    outcomes = {outcome.key: outcome for outcome in comparison.execute()}
    assert outcomes.pop(key).note.startswith("repeated, because it was damaged")
    assert {outcome.kind for outcome in outcomes.values()} == {"kept"}
    assert losses_of(tmp_path / key.folder) == whole


class Stops(Random):
    """Random search during which somebody presses Ctrl-C, once."""

    armed = True

    def tell(self, X: object, images: object = None, losses: object = None) -> None:
        super().tell(X, images, losses)
        if Stops.armed and self.seed == 1 and self.evaluations >= 20:
            Stops.armed = False
            os.kill(os.getpid(), signal.SIGINT)


@pytest.fixture
def stopped(tmp_path: Path) -> Any:
    """A comparison that was stopped in the middle of its second run."""
    optimizers.register("stops", Stops)
    Stops.armed = True
    with pytest.raises(harness.Interrupted):
        compare.run(small("stops"), tmp_path / "out")
    yield tmp_path / "out"
    optimizers._REGISTRY._factories.pop("stops")


def test_a_comparison_that_was_stopped_goes_on(stopped: Path, tmp_path: Path) -> None:
    status = {r.key.seed: r.state for r in compare.read(stopped).runs}
    assert status == {0: "finished", 1: "unfinished"}
    outcomes = compare.run(small("stops"), stopped, resume=True)
    assert kinds(outcomes) == {("stops", 0): "kept", ("stops", 1): "done"}
    compare.run(small("random"), tmp_path / "whole")
    for seed in (0, 1):
        keys = RunKey("voronoi", "mse", "stops", seed), RunKey("voronoi", "mse", "random", seed)
        assert losses_of(stopped / keys[0].folder) == losses_of(tmp_path / "whole" / keys[1].folder)


def test_a_run_whose_checkpoint_is_damaged_is_repeated(stopped: Path) -> None:
    folder = stopped / RunKey("voronoi", "mse", "stops", 1).folder
    _cut(folder / "run.ckpt")
    outcome = compare.run(small("stops"), stopped, resume=True)[1]
    assert outcome.kind == "done" and "it could not be continued" in outcome.note
    assert len(losses_of(folder)) == 40


def test_a_failure_is_recorded_and_the_others_go_on(
    misbehaving: type[Raises], tmp_path: Path
) -> None:
    plan = small("raises", "astray", "nowhere", "cma", seeds=1)
    outcomes = {outcome.key.configuration: outcome for outcome in compare.run(plan, tmp_path)}
    assert {configuration: outcome.kind for configuration, outcome in outcomes.items()} == {
        "raises": "failed", "astray": "failed", "nowhere": "failed", "cma": "done",
    }  # fmt: skip
    assert outcomes["raises"].note == "ArithmeticError: singular <matrix>"
    found = {r.key.configuration: r for r in compare.read(tmp_path).runs}
    assert found["raises"].state == "failed" and "in tell" in found["raises"].why
    assert "raise ArithmeticError" in found["raises"].why
    assert "must lie in [0, 1]" in found["astray"].why and "nan" in found["nowhere"].why
    misbehaving.mended = True
    again = kinds(compare.run(plan, tmp_path, resume=True))
    assert again[("raises", 0)] == "done" and again[("astray", 0)] == "failed"
    assert {r.key.configuration: r.state for r in compare.read(tmp_path).runs}[
        "raises"
    ] == "finished"


def test_a_process_that_dies_before_its_run_begins_costs_that_run_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def dying(work: Any, items: list[Any], jobs: int, lost: Any) -> Iterator[Outcome]:
        yield lost(items[0], "its worker process died")
        yield from map(work, items[1:])

    monkeypatch.setattr(processes, "in_processes", dying)
    monkeypatch.setattr(machine, "cores", lambda: 2)
    outcomes = compare.run(small("random", seeds=2), tmp_path, jobs=2)
    assert [outcome.kind for outcome in outcomes] == ["failed", "done"]
    said = (tmp_path / outcomes[0].key.folder / "error.txt").read_text()
    assert said == f"{outcomes[0].note}\n" == "its worker process died\n"


def test_a_run_that_another_process_executes_is_left_alone(tmp_path: Path) -> None:
    folder = tmp_path / RunKey("voronoi", "mse", "cma", 0).folder
    comparison = prepare(small(), tmp_path)
    folder.mkdir(parents=True)
    with files.locked(folder / ".lock") as mine:
        assert mine
        assert kinds(comparison.execute())["cma", 0] == "busy"
    assert kinds(compare.run(small(), tmp_path, resume=True))["cma", 0] == "done"


def test_what_others_write_meanwhile_is_kept(tmp_path: Path) -> None:
    first = prepare(small("cma", seeds=1), tmp_path)
    live = tmp_path / ".study.json.0123456789ab.tmp"

    def extend(_: Outcome) -> None:
        live.touch()
        compare.run(small("random", seeds=1), tmp_path, resume=True, command=["second"])

    first.execute(extend)
    assert live.exists()
    found = compare.read(tmp_path)
    assert {r.key.configuration: r.state for r in found.runs} == {
        "cma": "finished",
        "random": "finished",
    }
    assert sorted(call["command"] for call in found.calls) == [[], ["second"]]
    assert all(call["finished"] for call in found.calls)


def test_folders_of_other_things_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("0")
    with pytest.raises(RunDirectoryError, match="files that belong to no comparison"):
        compare.run(small(), tmp_path)
    with pytest.raises(FileNotFoundError, match="holds no comparison; make one"):
        compare.read(tmp_path)
    for text in ("{", "[]", '{"format": 1}', '{"format": 2, "cells": [["a", "b", 3, 4]]}'):
        (tmp_path / "study.json").write_text(text)
        with pytest.raises(RunDirectoryError, match="not the record of a comparison"):
            compare.run(small(), tmp_path, resume=True)


def test_more_jobs_than_cores_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at most one process per core"):
        compare.run(small(), tmp_path / "out", jobs=1000)
    assert not (tmp_path / "out").exists()
