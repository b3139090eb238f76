"""Renderers that take size, samples and seed: what is asked of them, and what becomes of it."""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest

from fide_plugins import FIDE, Fidelity, Float, Space, fit
from fide_plugins.errors import LossError, OptionError
from fide_plugins.fitting.callbacks import Event
from fide_plugins.fitting.fidelity import schedule_for
from fide_plugins.fitting.rendering import Rendered
from fide_plugins.fitting.schedule import Schedule
from fide_plugins.types import Float64

SPACE = Space(x=Float(0, 1), y=Float(0, 1), radius=Float(0.05, 0.4))
SMALL = Fidelity(size=(16, 64), samples=(1, 16))
ANSWER = {"x": 0.7, "y": 0.35, "radius": 0.2}
Asked = list[tuple[dict[str, float], tuple[int, int], int, int]]


def draw(params: dict[str, float], size: tuple[int, int], samples: int, seed: int) -> Float64:
    h, w = size
    y, x = (np.mgrid[0:h, 0:w] + 0.5) / np.array([h, w])[:, None, None]
    distance = np.hypot(x - params["x"], y - params["y"]) - params["radius"]
    inside = np.clip(0.5 - distance * min(h, w), 0, 1)
    noise = np.random.default_rng(seed).normal(0, 0.1 / np.sqrt(samples), size)
    image: Float64 = np.clip(0.2 + 0.6 * inside + 0.2 * x + noise, 0, 1)
    return image


def renderer(asked: Asked, fails_below: int = 0) -> Callable[..., Float64]:
    def render(
        params: dict[str, float], *, size: tuple[int, int], samples: int = 16, seed: int = 0
    ) -> Float64:
        asked.append((params, size, samples, seed))
        if min(size) < fails_below:
            raise ValueError("too small")
        return draw(params, size, samples, seed)

    return render


@pytest.fixture(scope="module")
def target() -> Float64:
    return draw(ANSWER, (64, 80), 64, 10**6)


def test_it_asks_for_finer_and_finer_renders_and_ends_with_the_finest(target: Float64) -> None:
    asked: Asked = []
    options: dict[str, Any] = {"workers": 0, "seed": 0, "until": "budget", "fidelity": SMALL}
    result = fit(renderer(asked), target, SPACE, 400, **options)
    fine = [(size, samples) for _, size, samples, _ in asked]
    assert fine[0] == ((16, 20), 1) and fine[-1] == ((64, 80), 16)
    assert fine == sorted(fine)
    assert len({seed for *_, seed in asked}) == len(asked)
    full = 64 * 80 * 16
    assert result.cost == pytest.approx(sum(h * w * n for (h, w), n in fine) / full)
    assert result.evaluations == 400 and result.cost < 200
    assert result.params == pytest.approx(ANSWER, abs=0.01)
    assert result.best is not None and result.best.image is not None
    assert result.best.image.shape == (64, 80, 3)


def test_with_a_small_budget_noise_is_measured_sooner(target: Float64) -> None:
    asked: Asked = []
    options: dict[str, Any] = {"workers": 0, "seed": 0, "until": "budget", "fidelity": SMALL}
    result = fit(renderer(asked), target, SPACE, 60, **options)
    assert len(asked) - result.evaluations - result.std_renders >= 8  # rendered twice


def test_noise_of_pixels_falls_with_more_samples(target: Float64) -> None:
    optimizer = FIDE(SPACE, target, seed=0)
    schedule = schedule_for(renderer([]), SMALL, optimizer)
    assert schedule is not None
    optimizer.tell(optimizer.ask(1), [target])
    optimizer.state.pixel_noise.variance = 0.16
    schedule.rise_to_finest()
    assert optimizer.state.pixel_noise.variance == pytest.approx(0.01)


def test_the_best_is_rendered_again_when_renders_become_finer(target: Float64) -> None:
    asked: Asked = []
    told: dict[tuple[Any, ...], list[Event]] = {}

    def note(event: Event) -> None:
        told.setdefault(asked[-1][1:3], []).append(event)

    result = fit(
        renderer(asked), target, SPACE, 200, workers=0, seed=1, callbacks=note, fidelity=SMALL
    )
    first = {fine: next(some)[0] for fine, some in groupby(asked, lambda one: one[1:3])}
    assert len(first) >= 3
    coarser: list[Event] = []
    for fine, params in first.items():
        if coarser:
            assert params == SPACE.decode(min(coarser, key=lambda event: event.loss).x)
        coarser = told[fine]
    known = np.isfinite(result.losses)  # losses of other renders are never compared
    assert known.sum() == len(coarser) and known[-len(coarser) :].all()


def test_a_renderer_without_them_is_fitted_as_before(target: Float64) -> None:
    def plain(params: dict[str, float]) -> Float64:
        return draw(params, (64, 80), 64, 0)

    def takes(params: dict[str, float], size: tuple[int, int], samples: int = 64) -> Float64:
        return draw(params, size, samples, 0)

    options: dict[str, Any] = {"budget": 60, "workers": 0, "seed": 3}
    before = fit(plain, target, SPACE, **options)
    after = fit(takes, target, SPACE, **options, fidelity=False)
    assert np.array_equal(before.losses, after.losses) and before.params == after.params
    assert before.cost == after.cost == before.evaluations


def test_sizes_are_asked_for_only_where_they_are_given(target: Float64) -> None:
    for fidelity in (None, Fidelity(samples=(1, 16))):
        asked: Asked = []
        options: dict[str, Any] = {"workers": 0, "seed": 0, "fidelity": fidelity}
        fit(renderer(asked), target, SPACE, 30, until="budget", **options)
        assert {size for _, size, *_ in asked} == {(64, 80)} and asked[0][2] == 1


def test_sizes_at_which_it_fails_are_left_out_and_said(target: Float64) -> None:
    asked: Asked = []
    with pytest.warns(RuntimeWarning, match="fail at 40 x 32 .*too small; the smallest .* 80 x 64"):
        result = fit(
            renderer(asked, fails_below=50), target, SPACE, 60, workers=0, seed=0, fidelity=SMALL
        )
    assert [min(size) for _, size, *_ in asked[:4]] == [16, 32, 64, 64]
    assert result.failures == 0 and result.evaluations == 60


def test_an_image_of_another_size_is_a_failure(target: Float64) -> None:
    def ignores(params: dict[str, float], size: tuple[int, int]) -> Float64:
        return draw(params, (64, 80), 16, 0)

    with pytest.warns(RuntimeWarning, match="80 x 64, and are used"):
        assert fit(ignores, target, SPACE, 30, workers=0, seed=0, fidelity=SMALL).failures == 0


def test_parameters_that_fail_at_any_size_are_withdrawn(target: Float64) -> None:
    asked: Asked = []

    def render(params: dict[str, float], size: tuple[int, int]) -> Float64:
        asked.append((params, size, 1, 0))
        if params == asked[0][0]:
            raise ValueError("these never")
        return draw(params, size, 16, 0)

    with pytest.warns(RuntimeWarning, match="these never"):
        result = fit(render, target, SPACE, 40, workers=0, seed=0, fidelity=SMALL)
    assert result.failures == 1 and min(asked[3][1]) == 16


def test_several_workers_and_a_resumed_run(target: Float64, tmp_path: Path) -> None:
    def render(params: dict[str, float], size: tuple[int, int], samples: int = 4) -> Float64:
        return draw(params, size, samples, 0)

    options: dict[str, Any] = {"executor": "threads", "workers": 3, "seed": 0, "until": "budget"}
    options["fidelity"] = SMALL
    first = fit(render, target, SPACE, 40, out=tmp_path, **options)
    second = fit(render, target, SPACE, 200, out=tmp_path, resume=True, **options)
    assert first.cost < 20 and first.cost < second.cost < 200
    assert second.evaluations == 200
    assert second.params == pytest.approx(ANSWER, abs=0.01)
    with pytest.raises(FileExistsError, match="fidelity"):
        fit(render, target, SPACE, 300, out=tmp_path, resume=True, **{**options, "fidelity": False})


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (lambda: Fidelity(size=(64, 32)), "size must be the least and the most, not"),
        (lambda: Fidelity(samples=(0, 4)), "samples of Fidelity must be a whole number >= 1"),
        (lambda: Fidelity(size=64), "size must be two numbers"),  # type: ignore[arg-type]
        (
            lambda: fit(len, np.zeros((8, 8)), 2, fidelity=3),  # type: ignore[arg-type]
            "fidelity must be Fidelity",
        ),
        (
            lambda: fit(lambda x: x, np.zeros((8, 8)), 2, fidelity=Fidelity()),
            "needs a renderer that takes size",
        ),
    ],
)
def test_wrong_use_is_an_error(made: Callable[[], object], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        made()


def test_a_fit_that_is_stopped_between_two_sizes_goes_on_there(
    target: Float64, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: Asked = []

    def stop(event: Event) -> bool:
        return event.evaluation == 30

    fit(
        renderer(asked), target, SPACE, 200, workers=0, seed=0, out=tmp_path,
        callbacks=stop, fidelity=SMALL,
    )  # fmt: skip
    assert min(asked[-1][1]) == 16
    begun: list[object] = []
    monkeypatch.setattr(Schedule, "begin", lambda schedule: begun.append(schedule))
    result = fit(
        renderer(asked), target, SPACE, 200, workers=0, seed=0, out=tmp_path, resume=True,
        until="budget", fidelity=SMALL,
    )  # fmt: skip
    fine = [one[1:3] for one in asked]
    assert not begun and fine == sorted(fine) and result.evaluations == 200


def test_a_smaller_target_is_for_a_named_loss(target: Float64) -> None:
    optimizer = FIDE(3, target, loss=lambda images: np.zeros(len(images)))
    with pytest.raises(LossError, match="named loss"):
        optimizer.evaluator.at_size((8, 8))


@pytest.mark.parametrize("ratio", [0.45, 0.55])
def test_samples_rise_where_noise_is_half_of_the_spread(ratio: float) -> None:
    """Of normal losses, whose candidates are rendered again with noise of that ratio."""
    flat, normal = np.ones((16, 16, 3)), NormalDist(0.4, 0.05)
    optimizer = FIDE(3, flat, loss=lambda images: images[:, 0, 0, 0], popsize=9, seed=0)
    schedule = schedule_for(renderer([]), Fidelity(samples=(1, 16)), optimizer)
    assert schedule is not None
    optimizer.tell(optimizer.ask(1), [flat])
    losses = [normal.inv_cdf(q) for q in (0.1, 0.2, 0.25, 0.3, 0.5, 0.7, 0.75, 0.8, 0.9)]
    for i in range(90):
        again = schedule.ask()
        if again is not None and schedule.samples == 1:
            second = losses[(i - 1) % 9] + np.sqrt(2) * ratio * normal.stdev
            schedule.received(again[0], Rendered(second * flat, 0.0))
        schedule.note(np.full(3, i / 90), losses[i % 9], spent=0.0, left=20.0)
    assert (schedule.samples > 1) == (ratio > 0.5)
