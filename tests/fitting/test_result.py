"""What a fit has found: shown, drawn, saved and read again."""

from __future__ import annotations

import json
import os
import pickle
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins import Choice, Float, Int, Result, Space, fit, load_run
from fide_plugins.errors import CheckpointError, FideError, OptionError
from fide_plugins.recording.storage import RunDirectoryError

V, U = np.mgrid[0:12, 0:12] / 11
NAMED = Space(
    angle=Float(0, 90, unit="deg"),
    size=Float(0.1, 0.5, log=True),
    rows=Int(1, 3),
    kind=Choice("disk", "<b>bar</b>"),
)
ANSWER = {"angle": 30.0, "size": 0.3, "rows": 2, "kind": "disk"}


def scene(p: dict[str, Any]) -> Any:
    along = np.cos(np.deg2rad(p["angle"])) * U + np.sin(np.deg2rad(p["angle"])) * V
    return (
        1
        / (1 + np.exp(8 * (along - p["size"] * p["rows"])))
        * (0.9 if p["kind"] == "disk" else 0.4)
    )


def both(p: dict[str, Any]) -> list[Any]:
    """Two views of different sizes."""
    return [scene(p), scene(p)[:8, :6]]


def found(render: Any, space: Any, answer: Any, **arguments: Any) -> Result:
    given: dict[str, Any] = {"budget": 80, "workers": 0, "seed": 3, "until": "budget"} | arguments
    return fit(render, render(answer), space, **given)


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Result:
    return found(scene, NAMED, ANSWER, out=tmp_path_factory.mktemp("kept") / "run")


def same(one: Result, other: Result) -> bool:
    """Whether both have found the same, as far as their texts and numbers say."""
    assert one.best is not None and other.best is not None
    numbers = ("curve", "losses", "improved_at", "path")
    return (
        all(np.array_equal(getattr(one, name), getattr(other, name)) for name in numbers)
        and (one.status, one.evaluations, one.failures, one.stopped, one.loss)
        == (other.status, other.evaluations, other.failures, other.stopped, other.loss)
        and repr(one.params) == repr(other.params)
        and repr(one.best) == repr(other.best)
        and one.best.undetermined == other.best.undetermined
        and repr(one.best.std) == repr(other.best.std)
        and repr(one.solutions) == repr(other.solutions)
    )


def test_the_path_ends_at_the_best_and_its_losses_fall(kept: Result) -> None:
    assert kept.best is not None and kept.path.shape == (len(kept.improved_at), NAMED.dim)
    np.testing.assert_array_equal(kept.path[-1], kept.best.x)
    np.testing.assert_array_equal(kept.losses[kept.improved_at], np.unique(kept.curve[:, 1])[::-1])


def test_a_run_that_is_read_is_the_result_of_the_fit(kept: Result) -> None:
    assert kept.out is not None
    read = load_run(kept.out)
    assert same(read, kept) and read.out == kept.out
    assert read.best is not None and kept.best is not None
    np.testing.assert_array_equal(read.best.image, kept.best.image)
    np.testing.assert_allclose(read.target, kept.target, atol=0.51 / 255)
    assert read.optimizer is not None and kept.optimizer is not None
    np.testing.assert_array_equal(read.optimizer.ask(), kept.optimizer.ask())


def test_views_and_a_mask_are_read_too(tmp_path: Path) -> None:
    mask = [None, np.eye(8, 6)]
    one = found(both, NAMED, ANSWER, mask=mask, out=tmp_path / "run")
    read = load_run(tmp_path / "run")
    assert same(read, one) and [view.shape for view in read.target] == [(12, 12, 3), (8, 6, 3)]
    here, there = (list(run.best.image) for run in (read, one))  # type: ignore[union-attr, arg-type]
    assert all(map(np.array_equal, here, there)) and len(here) == 2
    np.testing.assert_array_equal(read.weights[1], one.weights[1])
    assert (tmp_path / "run/summary.png").exists()
    assert len(one.plot().axes) == len(read.plot().axes)


def test_what_is_saved_is_what_out_writes(kept: Result, tmp_path: Path) -> None:
    assert kept.out is not None
    late = found(scene, NAMED, ANSWER)
    late.save(tmp_path / "late")
    kept.save(tmp_path / "copy")
    for name in ("late", "copy"):
        files = [{p.name for p in out.iterdir()} for out in (tmp_path / name, kept.out)]
        assert files[0] - {".run.lock"} == files[1] - {".run.lock"}
        assert same(load_run(tmp_path / name), kept)
        more = found(scene, NAMED, ANSWER, budget=84, out=tmp_path / name, resume=True)
        assert more.evaluations == 84
        with pytest.raises(RunDirectoryError):
            (late if name == "late" else kept).save(tmp_path / name)


def test_an_optimizer_that_went_on_is_not_saved_as_the_result(tmp_path: Path) -> None:
    result = found(scene, NAMED, ANSWER)
    assert result.optimizer is not None
    X = result.optimizer.ask()
    result.optimizer.tell(X, [scene(NAMED.decode(x)) for x in X])
    with pytest.raises(FideError, match="has gone on since"):
        result.save(tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_an_interrupted_run_is_read(tmp_path: Path) -> None:
    def stop(event: Any) -> None:
        if event.evaluation == 9:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as caught:
        found(scene, NAMED, ANSWER, out=tmp_path, callbacks=stop)
    read = load_run(tmp_path)
    assert read.evaluations == 10 and same(read, caught.value.result)  # type: ignore[attr-defined]
    assert (tmp_path / "summary.png").exists()


def test_a_killed_run_is_read_from_its_checkpoint(kept: Result, tmp_path: Path) -> None:
    assert kept.out is not None
    shutil.copytree(kept.out, tmp_path / "run")
    run = json.loads((tmp_path / "run/run.json").read_text())
    del run["totals"]
    (tmp_path / "run/run.json").write_text(json.dumps({**run, "state": "running"}))
    read = load_run(tmp_path / "run")
    assert (read.stopped, read.evaluations) == ("running", 80)
    assert read.status == kept.status and read.params == kept.params


@pytest.mark.parametrize(
    ("name", "content", "error"),
    [
        ("run.json", "{", RunDirectoryError),
        ("run.json", None, OptionError),
        ("run.ckpt", "", CheckpointError),
        ("run.ckpt", None, RunDirectoryError),
        ("solutions", {"x": 3}, RunDirectoryError),
        ("settings", {"dim": 6, "optimizer": "fide", "size": 12}, CheckpointError),
    ],
)
def test_damaged_runs_are_refused_by_name(
    kept: Result, tmp_path: Path, name: str, content: Any, error: type[Exception]
) -> None:
    assert kept.out is not None
    shutil.copytree(kept.out, tmp_path / "run")
    if "." not in name:
        run = json.loads((tmp_path / "run/run.json").read_text())
        (run if name == "settings" else run["totals"])[name] = content
        name, content = "run.json", json.dumps(run)
    if content is None:
        (tmp_path / "run" / name).unlink()
    else:
        (tmp_path / "run" / name).write_text(content)
    with pytest.raises(error) as caught:
        load_run(tmp_path / "run")
    assert isinstance(caught.value, FideError) and str(tmp_path / "run") in str(caught.value)


def test_text_and_page_have_units_and_deviations(kept: Result) -> None:
    assert kept.best is not None and kept.best.std is not None
    page, text = kept._repr_html_(), repr(kept)
    assert f"angle={kept.params['angle']:.1f}"[:8] in text and " ± " in text and " deg" in text
    assert f"kind={kept.params['kind']}" in text and str(kept.status) in text
    assert "<td>deg</td>" in page and "<b>bar" not in page and page.count("data:image/png") == 3

    class Balanced(HTMLParser):
        depth = 0

        def handle_starttag(self, tag: str, attrs: Any) -> None:
            assert tag not in ("script", "link", "iframe")
            self.depth += tag not in ("img", "br")

        def handle_endtag(self, tag: str) -> None:
            self.depth -= 1

    parser = Balanced()
    parser.feed(page)
    assert parser.depth == 0


def test_it_is_drawn(kept: Result) -> None:
    titles = [one.get_title(loc="left") for one in kept.plot().axes]
    assert titles == ["target", "best", "4x difference", "loss (mse)"]


def test_without_an_image_there_is_something_to_show() -> None:
    def fails(params: object) -> Any:
        raise KeyError

    with pytest.warns(RuntimeWarning), pytest.raises(FideError) as caught:
        fit(fails, scene(ANSWER), NAMED, workers=0)
    result = caught.value.result  # type: ignore[attr-defined]
    assert result.best is None and "best loss none" in repr(result)
    assert "waiting" not in result._repr_html_() and len(result.plot().axes) == 2


def test_it_can_be_pickled(kept: Result) -> None:
    assert same(pickle.loads(pickle.dumps(kept)), kept)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes on Windows")
@pytest.mark.parametrize("name", ["run.json", "run.ckpt"])
def test_a_pipe_in_a_run_is_refused_and_not_waited_for(
    kept: Result, tmp_path: Path, name: str
) -> None:
    assert kept.out is not None
    shutil.copytree(kept.out, tmp_path / "run")
    (tmp_path / "run" / name).unlink()
    os.mkfifo(tmp_path / "run" / name)
    with pytest.raises((OSError, FideError), match="pipe"):
        load_run(tmp_path / "run")
