"""The same as FIDE alone, and the same again (points 4 and 21); dumps in mid-run (22)."""

from __future__ import annotations

import math
import pickle
import random
import threading
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import nevergrad as ng
import numpy as np
import pytest
import torch

from fide_adapters.nevergrad import FIDE as REGISTERED, IMAGE, NoImagesWarning, ParametrizedFIDE
from fide_plugins.errors import ProtocolError
from fide_plugins.fide import FIDE
from fide_plugins.types import Float32, Float64

from .conftest import TARGET, box, fide, mse, objective, render, told


@pytest.mark.parametrize("settings", [{}, {"preset": "fast", "popsize": 12}])
def test_point_4_the_same_candidates_as_fide_alone(settings: dict[str, Any]) -> None:
    """Steps between the generations, too, where there are some."""
    optimizer, alone = fide(**settings), FIDE(6, TARGET, seed=0, **settings)
    steps = 0
    for _ in range(150):
        candidate, X = optimizer.ask(), alone.ask(1)
        steps += alone.state.population.is_pending(X[0]) and not alone.state.population.awaited
        np.testing.assert_allclose(candidate.value, X[0], atol=1e-12)
        optimizer.tell(candidate, render(candidate.value))
        alone.tell(X, [render(X[0])])
        if alone.best is not None and alone.best.loss < 1e-8:
            break  # from here on rounding decides
    assert alone.best is not None and alone.best.loss < 1e-3
    assert alone.evaluations > 40
    assert (steps > 0) == ("preset" not in settings)
    assert optimizer.recommend().loss == pytest.approx(alone.best.loss, rel=1e-6)


def test_point_4_losses_computed_here_or_there_are_the_same() -> None:
    one, other = fide(), fide()
    for _ in range(60):
        a, b = one.ask(), other.ask()
        np.testing.assert_array_equal(a.value, b.value)
        image = render(a.value)
        one.tell(a, image)
        other.tell(b, mse(image), image=image)
        assert a.loss == pytest.approx(b.loss, rel=1e-12)


def test_point_4_without_images_it_is_cma_es() -> None:
    """With a target or without, and with an image that has nothing to be compared with."""
    alone = FIDE(6, TARGET, seed=0, proposer="none")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NoImagesWarning)
        others = [fide(), fide(target=None), fide(target=None)]
        for _ in range(150):
            X = alone.ask(1)
            candidates = [optimizer.ask() for optimizer in others]
            for candidate in candidates:
                np.testing.assert_allclose(candidate.value, X[0], atol=1e-12)
            image = render(X[0])
            alone.tell(X, losses=[mse(image)])
            others[0].tell(candidates[0], mse(image))
            others[1].tell(candidates[1], mse(image))
            others[2].tell(candidates[2], mse(image), image=image)


def test_without_a_target_it_says_so_once() -> None:
    optimizer = fide(target=None)
    with pytest.warns(NoImagesWarning, match=r"no target.*CMA-ES") as record:
        for _ in range(30):
            candidate = optimizer.ask()
            optimizer.tell(candidate, 1.0)
    assert len(record) == 1


def never(x: Any) -> bool:
    return False


@pytest.mark.filterwarnings("ignore:Clipping very high value", "ignore:Could not bypass")
@pytest.mark.parametrize("how", ["failed", "violation", "constraint"])
def test_invalid_candidates_have_no_image_and_are_no_reason_to_warn(how: str) -> None:
    """The first ones, more than a generation, are all invalid; each valid one has its image."""
    optimizer = fide(budget=200)
    if how == "constraint":
        optimizer.parametrization.register_cheap_constraint(never)
    for _ in range(30):
        candidate = optimizer.ask()
        violation = [1.0] if how == "violation" else None
        optimizer.tell(candidate, math.inf if how == "failed" else 1.0, violation)
    if how == "constraint":
        return
    for _ in range(10):
        candidate = optimizer.ask()
        optimizer.tell(candidate, render(candidate.value))
    assert optimizer.num_images == 10


def test_a_few_losses_without_images_are_no_reason_to_warn() -> None:
    optimizer = fide()
    told(optimizer, 1)
    for _ in range(20):
        optimizer.tell(optimizer.ask(), 1.0)


def run(seed: int, parametrization: Any) -> list[Float64]:
    optimizer = fide(parametrization, seed=None)
    optimizer.parametrization.random_state.seed(seed)
    return told(optimizer, 40)


def test_point_21_the_random_state_of_the_parametrization_is_the_seed() -> None:
    first, again, other = run(5, box()), run(5, box()), run(6, box())
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first[0], other[0])
    seeded = box()
    seeded.random_state.seed(5)
    optimizer = fide(seeded, seed=None)
    np.testing.assert_array_equal(told(optimizer, 40), first)


def test_point_21_choices_are_reproducible_too() -> None:
    def values(seed: int) -> list[Any]:
        parametrization = ng.p.Tuple(ng.p.Choice(list("abcd")), ng.p.Scalar(lower=0, upper=1))
        optimizer = fide(parametrization, seed=None)
        parametrization.random_state.seed(seed)
        found = []
        for _ in range(30):
            candidate = optimizer.ask()
            optimizer.tell(candidate, render(np.full(6, candidate.value[1])))
            found.append(candidate.value)
        return found

    assert values(3) == values(3) != values(4)


def test_point_21_global_random_state_is_left_alone() -> None:
    optimizer = fide(seed=None)
    optimizer.parametrization.random_state.seed(1)
    np.random.seed(7)
    torch.manual_seed(7)
    random.seed(7)
    told(optimizer, 40)
    drawn = np.random.random(), torch.rand(1).item(), random.random()
    np.random.seed(7)
    torch.manual_seed(7)
    random.seed(7)
    assert drawn == (np.random.random(), torch.rand(1).item(), random.random())


def test_an_off_center_beginning_is_respected() -> None:
    parametrization = ng.p.Array(init=[0.2, 0.8]).set_mutation(sigma=0.02).set_bounds(0, 1)
    optimizer = fide(parametrization, popsize=1000)
    X = np.array([optimizer.ask().value for _ in range(1000)])
    np.testing.assert_allclose(X.mean(axis=0), [0.2, 0.8], atol=0.005)
    np.testing.assert_allclose(X.std(axis=0), 0.02, rtol=0.1)


# -- dumps -----------------------------------------------------------------------------------------

SETTINGS: dict[str, dict[str, Any]] = {
    "default": {},
    "published": {"preset": "paper", "popsize": 6, "options": {"epochs": 1, "batch_size": 6}},
    "losses only": {"options": {"proposer": "none"}},
}


@pytest.mark.parametrize("steps", [0, 4, 40])
@pytest.mark.parametrize("what", SETTINGS)
def test_point_22_continues_identically(what: str, steps: int, tmp_path: Path) -> None:
    """With candidates out, which either may be told."""
    original = fide(**SETTINGS[what])
    told(original, steps)
    out = [original.ask() for _ in range(3)]
    original.dump(tmp_path / "dump")
    copy = REGISTERED.load(tmp_path / "dump")
    assert copy.name == original.name and copy.num_ask == original.num_ask
    theirs = pickle.loads(pickle.dumps(out))  # as they come back from elsewhere
    for ours, its in zip(out, theirs, strict=True):
        original.tell(ours, render(ours.value))
        copy.tell(its, render(its.value))
    np.testing.assert_array_equal(told(original, 20), told(copy, 20))
    assert copy.num_tell == original.num_tell and copy.num_tell_not_asked == 0
    np.testing.assert_array_equal(copy.recommend().value, original.recommend().value)


def test_point_22_before_anything_was_asked(tmp_path: Path) -> None:
    original = fide(seed=None)
    original.parametrization.random_state.seed(3)
    original.dump(tmp_path / "dump")
    copy = REGISTERED.load(tmp_path / "dump")
    np.testing.assert_array_equal(told(original, 5), told(copy, 5))


def test_point_22_a_dump_of_a_loaded_dump(tmp_path: Path) -> None:
    original = fide()
    told(original, 20)
    for name in ("a", "b"):
        original.dump(tmp_path / name)
        copy = REGISTERED.load(tmp_path / name)
        copy.dump(tmp_path / name)  # before it is used
    np.testing.assert_array_equal(told(REGISTERED.load(tmp_path / "b"), 12), told(original, 12))


def test_a_dump_of_another_version_is_refused() -> None:
    state = fide().__getstate__()
    with pytest.raises(ProtocolError, match="another version"):
        fide().__setstate__({**state, "_format": 1})


def find_image(optimizer: Any, candidate: Any, loss: float) -> None:
    candidate._meta[IMAGE] = render(candidate.value)


class DumpAt:
    """Dump at one of the calls."""

    def __init__(self, path: Path, at: int) -> None:
        self.path, self.at, self.calls = path, at, 0

    def __call__(self, optimizer: Any, *_: Any) -> None:
        self.calls += 1
        if self.calls == self.at:
            ng.callbacks.OptimizerDump(self.path)(optimizer)


def test_point_22_the_file_holds_no_images(tmp_path: Path) -> None:
    """Neither the best one nor the one that is being told, wherever that came from."""
    original = fide(budget=20)
    values = told(original, 10)
    original.register_callback("tell", find_image)
    original.register_callback("tell", ng.callbacks.OptimizerDump(tmp_path / "dump"))

    def objective(x: Any) -> float:
        values.append(np.array(x))
        return mse(render(x))

    original.minimize(objective)
    assert original.num_images == len(values) == 20
    data = (tmp_path / "dump").read_bytes()
    for x in values:
        assert render(x)[7].tobytes() not in data
    assert TARGET[7].tobytes() in data


def remember(values: list[Any]) -> Any:
    def called(x: Any) -> Float32:
        values.append(np.array(x))
        return render(x)

    return called


@pytest.mark.parametrize("event", ["ask", "tell"])
@pytest.mark.parametrize("mode", [{"batch_mode": True}, {"batch_mode": False}])
def test_point_22_from_a_callback_in_minimize(
    event: str, mode: dict[str, Any], tmp_path: Path
) -> None:
    """What was with the executor is asked and rendered again, then all goes on as it did."""
    values: list[Any] = []
    original = fide(budget=60)
    original.register_callback(event, DumpAt(tmp_path / "dump", 25))
    expected = original.minimize(remember(values), **mode)
    again: list[Any] = []
    copy = REGISTERED.load(tmp_path / "dump")
    copy.remove_all_callbacks()
    assert copy.num_tell == 24
    recommended = copy.minimize(remember(again), **mode)
    np.testing.assert_array_equal(again, values[24:])
    assert copy.num_tell == copy.num_ask == 60 and copy.num_tell_not_asked == 0
    np.testing.assert_array_equal(recommended.value, expected.value)


def test_point_22_with_running_futures(tmp_path: Path) -> None:
    """OptimizerDump at every tell, with threads that cannot be pickled."""
    lock = threading.Lock()

    def slow(x: Any) -> Float32:
        with lock:
            time.sleep(0.001)
        return render(x)

    original = fide(budget=40, workers=4)
    original.register_callback("tell", ng.callbacks.OptimizerDump(tmp_path / "dump"))
    with ThreadPoolExecutor(4) as executor:
        original.minimize(slow, executor=executor)
    copy = REGISTERED.load(tmp_path / "dump")
    assert copy.num_tell == 39 and len(copy._repeated) == 1
    copy.remove_all_callbacks()
    with ThreadPoolExecutor(4) as executor:
        copy.minimize(slow, executor=executor)
    assert copy.num_tell == copy.num_ask == 40
    np.testing.assert_allclose(copy.recommend().value, original.recommend().value)


def test_a_dump_goes_on_with_the_settings_it_was_made_with(tmp_path: Path) -> None:
    settings = ParametrizedFIDE(target=TARGET, loss="perceptual", popsize=7, seed=1)
    original = settings(box(), budget=30)
    told(original, 9)
    original.dump(tmp_path / "dump")
    copy = settings.load(tmp_path / "dump")
    a, b = original.ask(), copy.ask()
    image = render(np.full(6, 0.4))
    original.tell(a, image)
    copy.tell(b, image)
    assert a.loss == b.loss != pytest.approx(mse(image))
    assert copy._configured_optimizer == settings
    with pytest.raises(AssertionError):
        ng.optimizers.OnePlusOne.load(tmp_path / "dump")


def test_dumping_changes_nothing(tmp_path: Path) -> None:
    dumped, other = fide(budget=30), fide(budget=30)
    dumped.register_callback("tell", ng.callbacks.OptimizerDump(tmp_path / "dump"))
    one, two = dumped.minimize(objective), other.minimize(objective)
    np.testing.assert_array_equal(one.value, two.value)


class Deliver:
    """Attach the images of all jobs that wait, some at a time; then dump, if there is a path."""

    def __init__(self, path: Path | None = None) -> None:
        self.path, self.calls = path, 0

    def __call__(self, optimizer: Any, told: Any, loss: float) -> None:
        self.calls += 1
        if self.calls % 3 != 1:
            return
        waiting = [candidate for candidate, _ in optimizer._finished_jobs]
        for candidate in waiting:
            candidate._meta[IMAGE] = render(candidate.value)
        if self.path is not None:
            optimizer.dump(self.path)
        assert all(IMAGE in candidate._meta for candidate in waiting)


@pytest.mark.filterwarnings("ignore:num_workers = 3 > 1 is suboptimal")  # of no executor
def test_dumping_takes_no_image_of_a_candidate(tmp_path: Path) -> None:
    """Each image reaches the search with its own candidate, and none the file."""
    dumped, other = fide(budget=30, workers=3), fide(budget=30, workers=3)
    dumped.register_callback("tell", Deliver(tmp_path / "dump"))
    other.register_callback("tell", Deliver())
    values: list[Any] = []

    def objective(x: Any) -> float:
        values.append(np.array(x))
        return mse(render(x))

    one, two = dumped.minimize(objective), other.minimize(objective)
    assert dumped.num_images == other.num_images == 30
    np.testing.assert_array_equal(one.value, two.value)
    data = (tmp_path / "dump").read_bytes()
    assert not any(render(x)[7].tobytes() in data for x in values)
    copy = REGISTERED.load(tmp_path / "dump")
    assert len(copy._repeated) == 3 and not any(IMAGE in c._meta for c in copy._repeated)
    assert all(c.random_state is copy.parametrization.random_state for c in copy._repeated)
    copy.remove_all_callbacks()
    copy.register_callback("tell", Deliver())
    np.testing.assert_array_equal(copy.minimize(objective).value, one.value)
