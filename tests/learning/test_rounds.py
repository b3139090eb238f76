"""`preset="global"`: rounds of learning before the search."""

from __future__ import annotations

import json
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fide_lab import run as harness
from fide_plugins import FIDE, Float, Group, Space, fit
from fide_plugins.cli import progress
from fide_plugins.errors import CheckpointError, OptionError, RenderError
from fide_plugins.fitting import workers as choice
from fide_plugins.fitting.stopping import Stopping
from fide_plugins.learning import Model, hypotheses as rounds, rendering
from fide_plugins.recording.storage import RunDirectoryError
from fide_plugins.types import Float64

from .conftest import SIDE, SPACE, disk

pytestmark = pytest.mark.thorough

TRUTH = {"x": 0.3, "y": 0.65, "gray": 0.5, "hidden": 0.5}
PICTURE = disk(TRUTH)
BUDGET = 500
SHARES = (200, 100)  # renders of the two rounds, whole shards


class Stop(BaseException):
    """As the end of a process."""


class Disk:
    """Renders the disk; counts, and stops once after some renders."""

    name = "disk"

    def __init__(self, stop: int | None = None) -> None:
        self.renders, self._stop = 0, stop

    def __call__(self, params: dict[str, Any]) -> Float64:
        if self.renders == self._stop:
            self._stop = None
            raise Stop
        self.renders += 1
        return disk(params)


def allow_few(patch: pytest.MonkeyPatch) -> None:
    """Allow a small budget and learn briefly: what is tested does not depend on them."""
    patch.setattr(rounds, "LEAST", BUDGET)
    patch.setattr(rounds, "_PASSES", 2)


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    allow_few(monkeypatch)


def fitted(render: Any = disk, picture: Float64 = PICTURE, **options: Any) -> Any:
    given: dict[str, Any] = {
        "budget": BUDGET,
        "until": "budget",
        "workers": 0,
        "seed": 3,
        "preset": "global",
    }
    options = given | options
    return fit(render, picture, SPACE, **options)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Disk, Path]:
    """A fit that nothing has stopped, its renderer, and its folder."""
    render, folder = Disk(), tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        allow_few(patch)
        result = fitted(render, out=folder)
    return result, render, folder


def test_all_renders_count_and_the_search_begins_at_the_answer(
    whole: tuple[Any, Disk, Path],
) -> None:
    result, render, folder = whole
    assert result.evaluations == BUDGET
    more = 2 + 4  # one a round, to know the shape, and four again
    assert render.renders == BUDGET + more + result.std_renders
    learning = result.curve[: sum(SHARES), 1]
    assert np.isinf(learning).all() and np.isfinite(result.curve[sum(SHARES) :, 1]).all()
    assert result.best.loss < 1e-5
    assert [result.params[name] for name in ("x", "y", "gray")] == pytest.approx(
        [TRUTH[name] for name in ("x", "y", "gray")], abs=0.02
    )
    names = sorted(path.name for path in (folder / "rounds").iterdir())
    assert names == ["first.fide", "second.fide"]  # the renders are gone
    first = Model.load(folder / "rounds" / "first.fide")
    assert first.report.renders + first.report.held_out == SHARES[0]
    search = FIDE(SPACE, PICTURE, learned=folder / "rounds" / "second.fide", seed=3)
    assert result.curve[sum(SHARES), 1] == pytest.approx(  # the search is that of the model
        np.square(disk(SPACE.decode(search.ask(1)[0])) - PICTURE).mean(), rel=1e-4
    )


@pytest.mark.usefixtures("few")
def test_a_process_that_may_start_no_other_renders_in_threads_as_for_any_preset(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for module in (choice, rendering):
        monkeypatch.setattr(module, "current_process", lambda: SimpleNamespace(daemon=True))
    with pytest.warns(RuntimeWarning, match="cannot start others, so render runs in threads"):
        assert fitted(workers=2).evaluations == BUDGET
    with pytest.raises(OptionError, match="cannot start others; give executor='threads'"):
        fitted(workers=2, executor="processes")


def test_solutions_say_which_evaluation_of_the_run_found_them(
    whole: tuple[Any, Disk, Path],
) -> None:
    result, _, folder = whole
    best, losses = result.best, result.curve[:, 1]
    assert result.optimizer.evaluations == BUDGET
    assert losses[best.evaluation] == best.loss < losses[best.evaluation - 1]
    totals = json.loads((folder / "run.json").read_text())["totals"]
    assert totals["best_evaluation"] == best.evaluation
    assert all(one.evaluation >= sum(SHARES) for one in result.solutions)
    assert sum(SHARES) <= result.optimizer.state.improved_at <= best.evaluation


def test_learned_renders_change_no_candidate_and_not_when_a_search_is_stalled() -> None:
    def search(renders: int) -> tuple[Any, int]:
        opt = FIDE(SPACE, PICTURE, seed=0, popsize=4)
        opt.begin_with(None, renders)
        stopping = Stopping(10_000, until="stalled")
        asked = []
        while not stopping.reached([0.5] * (opt.evaluations - renders), 0.0, 0.0, True, opt):
            X = opt.ask()
            asked.append(X)
            opt.tell(X, None, np.maximum(0.5, X[:, 0]))
        return np.concatenate(asked), opt.evaluations

    (asked, n), (same, more) = search(0), search(400)
    np.testing.assert_array_equal(asked, same)
    assert more == n + 400 and n < 1000


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize("stop", [150, 270, 400])  # in each part
def test_a_run_that_was_stopped_goes_on_as_if_it_had_not_been(
    stop: int, tmp_path: Path, whole: tuple[Any, Disk, Path]
) -> None:
    render = Disk(stop)
    with pytest.raises(Stop):
        fitted(render, out=tmp_path)
    again = fitted(render, out=tmp_path, resume=True)
    assert render.renders <= BUDGET + 2 + 100 + 2 + 8  # of a shard, what was not written is lost
    np.testing.assert_array_equal(again.curve, whole[0].curve)
    np.testing.assert_array_equal(again.best.x, whole[0].best.x)


@pytest.mark.usefixtures("few")
def test_a_round_that_is_done_is_not_done_again(tmp_path: Path) -> None:
    """Also where a time limit would make another model of it."""
    render = Disk(stop=280)
    with pytest.raises(Stop):
        fitted(render, out=tmp_path)
    first = (tmp_path / "rounds" / "first.fide").read_bytes()
    with pytest.raises(RunDirectoryError, match="budget is 500 there and 700 here"):
        fitted(render, out=tmp_path, resume=True, budget=700)
    result = fitted(render, out=tmp_path, resume=True, time=600)
    assert (tmp_path / "rounds" / "first.fide").read_bytes() == first
    assert result.evaluations == BUDGET
    assert np.isinf(result.curve[:, 1]).sum() == sum(SHARES)
    with pytest.raises(RunDirectoryError, match="budget is 500 there and 700 here"):
        fitted(render, out=tmp_path, resume=True, budget=700)  # after the end, too


@pytest.mark.usefixtures("few")
def test_a_run_that_goes_on_with_another_version_is_told_which_folder(tmp_path: Path) -> None:
    """The user gave no model, so that leaving it out would be no remedy."""
    render: Any = Disk(stop=280)
    render.version = "1"
    with pytest.raises(Stop):
        fitted(render, out=tmp_path)
    render.version = "2"
    with pytest.raises(OptionError, match="rounds holds models .*name another run directory"):
        fitted(render, out=tmp_path, resume=True)
    render.version = 2
    with pytest.raises(OptionError, match="a text such as '2'") as raised:
        fitted(render, out=tmp_path, resume=True)
    assert "name another run directory" not in str(raised.value)


LAMPS = Space(lamps=2 * Group(x=Float(0, 1), y=Float(0, 1)))


def lamps(params: dict[str, Any]) -> Float64:
    """Mean of two soft disks."""
    image: Float64 = np.mean([disk({**lamp, "gray": 1}) for lamp in params["lamps"]], axis=0)
    return image


@pytest.mark.usefixtures("few")
def test_only_the_second_model_has_an_emulator(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Model, "knows", lambda *_: True)  # of 200 renders it is a guess
    picture = lamps({"lamps": [{"x": 0.3, "y": 0.3}, {"x": 0.7, "y": 0.6}]})
    both = rounds.Rounds(lamps, LAMPS, picture, BUDGET, 0, tmp_path)
    said: list[tuple[int, str]] = []
    learned = both.learn(1, lambda n, doing: said.append((n, doing)))
    assert Model.load(tmp_path / "first.fide").emulator is None
    assert learned.model.emulator is not None
    assert said == [
        (100, "rendering for the first model"), (200, "rendering for the first model"),
        (200, "first model, pass 1/2"), (200, "first model, pass 2/2"),
        *((200, f"first model, judging {n}/4") for n in (1, 2, 3, 4)),  # every 50th is held out
        (300, "rendering for the second model"),
        (300, "second model, pass 1/2"), (300, "second model, pass 2/2"),
        (300, "second emulator, pass 1/2"), (300, "second emulator, pass 2/2"),
        *((300, f"second model, judging {n}/6") for n in (1, 2, 3, 4, 5, 6)),
    ]  # fmt: skip
    said.clear()
    again = both.learn(1, lambda n, doing: said.append((n, doing)))
    assert again.model.emulator is not None and not said


@pytest.mark.usefixtures("few")
def test_an_unknown_picture_has_no_second_round() -> None:
    noise = np.random.default_rng(0).random((SIDE, SIDE, 3))
    with pytest.warns(RuntimeWarning, match="learned nothing like this picture"):
        result = fitted(picture=noise, budget=5000)  # of a few renders it could not tell
    assert result.evaluations == 5000
    assert np.isinf(result.curve[:2000, 1]).all()
    assert np.isfinite(result.curve[2000:, 1]).all()


@pytest.mark.usefixtures("few")
def test_busy_counts_the_search_alone(monkeypatch: pytest.MonkeyPatch, learned: Path) -> None:
    """The rounds render, too, and `busy` knows nothing of their renders."""
    rendered, rounds_took = 0.0, 2.0

    def learn(*_: Any) -> rounds.Learned:
        time.sleep(rounds_took)
        return rounds.Learned(Model.load(learned), BUDGET - 10)

    def slow(params: dict[str, Any]) -> Float64:
        nonlocal rendered
        start = time.perf_counter()
        time.sleep(0.05)
        image = disk(params)
        rendered += time.perf_counter() - start
        return image

    monkeypatch.setattr(rounds.Rounds, "learn", learn)
    result = fitted(slow)
    assert result.evaluations == BUDGET
    assert rendered / (rendered + rounds_took) < result.busy <= 1


@pytest.mark.usefixtures("few")
def test_a_fit_says_what_it_does_before_the_search_and_how_fast(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], learned: Path
) -> None:
    """As `fide fit` prints it where standard error is no terminal."""

    def learn(self: Any, workers: int, show: Any) -> rounds.Learned:
        for renders in (100, 200):
            time.sleep(0.1)
            show(renders, "rendering for the first model")
        show(200, "first model, pass 1/2")
        return rounds.Learned(Model.load(learned), BUDGET - 10)

    monkeypatch.setattr(rounds.Rounds, "learn", learn)
    monkeypatch.setattr(progress, "_EVERY", 0.0)
    fitted(progress=progress.lines("fide fit"))
    first, second, third, *_, last = capsys.readouterr().err.splitlines()
    for line, done in ((first, 100), (second, 200)):
        assert f"{done}/{BUDGET}" in line and line.endswith("rendering for the first model")
    *_, speed, unit = second.partition("  rendering")[0].split()
    assert 0 < float(speed) <= 1000 and unit == "renders/s"  # 100 in 0.1 seconds or more
    assert third.endswith("first model, pass 1/2")
    assert f"{BUDGET}/{BUDGET}  best" in last and "inf" not in first + second + third + last


@pytest.mark.usefixtures("few")
def test_a_time_limit_leaves_half_of_it_to_the_search() -> None:
    made = rounds.rounds_of(
        disk, SPACE, PICTURE, {"preset": "global"}, budget=BUDGET, seed=0, out=None, seconds=60.0
    )
    assert made is not None and made.seconds == 30.0


def test_a_search_gets_its_own_preset_and_the_model_unless_its_state_has_hypotheses(
    learned: Path,
) -> None:
    given = {"preset": "global", "learned": learned, "popsize": 8}
    kept = given | {}
    new = rounds.search_options(given, disk, resumed=False)
    assert isinstance(new.pop("learned"), Model)
    assert new == rounds.search_options(given, disk, resumed=True)
    assert new == {"preset": "balanced", "popsize": 8}
    assert given == kept
    missing = {"learned": learned.with_name("none")}
    with pytest.raises(FileNotFoundError):
        rounds.search_options(missing, disk, resumed=False)
    with pytest.warns(RuntimeWarning, match="has its hypotheses and goes on without the file"):
        assert rounds.search_options(missing, disk, resumed=True) == {}
    with pytest.raises(CheckpointError):  # a file that is there is checked nevertheless
        rounds.search_options({"learned": __file__}, disk, resumed=True)


@pytest.mark.parametrize("budget", [None, 2000, 9999])
def test_a_small_budget_is_refused(budget: int | None, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"a budget of at least 10,000 renders, not (None|\d+)"):
        fitted(budget=budget, time=60, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_what_it_cannot_do_is_refused_before_anything_is_rendered(learned: Path) -> None:
    render = Disk()
    with pytest.raises(OptionError, match="leave out learned"):
        fitted(disk, budget=10_000, learned=learned)
    with pytest.raises(OptionError, match="the target is a list of 2 views"):
        fitted(render, budget=10_000, views=[PICTURE])
    with pytest.raises(OptionError, match=r"is of fit\(\.\.\.\), fide fit and fide run"):
        FIDE(SPACE, PICTURE, preset="global")
    assert render.renders == 0


class Scene:
    """The disk as a task."""

    name, dim, space = "disk", SPACE.dim, SPACE
    target = np.repeat(PICTURE[..., None], 3, axis=2).astype(np.float32)

    def render(self, X: Float64, seed: Any = None) -> Any:
        return np.stack([disk(SPACE.decode(x)) for x in X])


@pytest.mark.usefixtures("few")
def test_the_run_loop_has_it_too_and_resumes(tmp_path: Path) -> None:
    options = {"preset": "global"}
    arguments: dict[str, Any] = {"options": options, "out": tmp_path / "run"}
    result = harness.run(Scene(), "fide", "mse", BUDGET, 3, **arguments)
    assert result.evaluations == len(result.losses) == BUDGET
    assert np.isinf(result.losses[: sum(SHARES)]).all() and result.best_loss < 1e-5
    there = json.loads((tmp_path / "run" / "run.json").read_text())
    assert there["settings"]["options"] == options
    again = harness.run(Scene(), "fide", "mse", BUDGET, 3, **arguments, resume=True)
    np.testing.assert_array_equal(again.losses, result.losses)
    with pytest.raises(OptionError, match="at least 500 renders"):
        harness.run(Scene(), "fide", "mse", 400, 3, options=options)


class Fails(Scene):
    """Fails once, in the search."""

    def __init__(self) -> None:
        self.left = sum(SHARES) + 100

    def render(self, X: Float64, seed: Any = None) -> Any:
        before, self.left = self.left, self.left - len(X)
        if self.left < 0 <= before:
            raise RuntimeError("no memory")
        return super().render(X, seed)


@pytest.mark.usefixtures("few")
def test_a_run_removes_the_renders_that_an_earlier_process_left(tmp_path: Path) -> None:
    arguments: dict[str, Any] = {"options": {"preset": "global"}, "out": tmp_path / "run"}
    scene = Fails()
    with pytest.raises(RenderError, match="no memory"):
        harness.run(scene, "fide", "mse", BUDGET, 3, **arguments)
    renders = tmp_path / "run" / "rounds" / "first.fide.renders"
    renders.mkdir()  # by a process that was killed before it removed them
    result = harness.run(scene, "fide", "mse", BUDGET, 3, **arguments, resume=True)
    assert result.evaluations == BUDGET and not renders.exists()


@pytest.mark.slow
def test_the_least_budget_in_earnest() -> None:
    result = fitted(budget=10_000)
    assert result.evaluations == 10_000 and result.best.loss < 1e-8
