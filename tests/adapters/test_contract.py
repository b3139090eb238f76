"""What holds for FIDE in Optuna and in Nevergrad: the same candidates, images and refusals."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

import nevergrad as ng
import numpy as np
import optuna
import pytest
import torch
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from PIL import Image

from fide_adapters.nevergrad import NoImagesWarning, ParametrizedFIDE
from fide_adapters.optuna import FIDESampler
from fide_plugins import FIDE, Choice, Float, Int, Space
from fide_plugins.errors import ImageError
from fide_plugins.space import Kind
from fide_plugins.types import Float32

Params = dict[str, Any]
Kinds = dict[str, Any]

SIZE = 8
GRID = (np.arange(SIZE) + 0.5) / SIZE
FLOATS: Kinds = {name: Float(0, 1) for name in "abcde"}
MIXED: Kinds = {
    "a": Float(0.01, 1, log=True),
    "b": Int(-3, 4),
    "c": Choice("u", "v", "w"),
    "d": Int(1, 64, log=True),
    "e": Choice(False, True),
}


def disk(p: Params) -> Float32:
    """Image (8, 8, 3) of a soft disk at a, b, of color c, d, e; choices count from 0."""
    a, b, c, d, e = (float("uvw".find(v)) / 2 if isinstance(v, str) else v for v in p.values())
    far = np.hypot(GRID[None, :] - a, GRID[:, None] - b / (8 if isinstance(b, int) else 1))
    color = np.array([c, d / (64 if isinstance(d, int) else 1), e], float)
    image: Float32 = ((1 / (1 + np.exp(15 * (far - 0.3))))[..., None] * color).astype(np.float32)
    return image


def views(p: Params) -> list[Any]:
    return [disk(p), disk(p)[:, :5] / 2]


ANSWER: Params = {"a": 0.7, "b": 0.35, "c": 0.9, "d": 0.4, "e": 0.2}
TARGET = disk(ANSWER)


class Adapter(Protocol):
    """FIDE in one of the frameworks: asked and told one candidate at a time."""

    whole: bool  # whether it asks as FIDE that is asked for whole generations
    warning: type[Warning]

    def __init__(self, kinds: Kinds, target: Any, **settings: Any) -> None: ...

    def ask(self) -> tuple[Any, Params]:
        """A candidate, and its parameters."""

    def tell(self, candidate: Any, loss: Any = None, **result: Any) -> None:
        """With `image`."""

    @property
    def images(self) -> int:
        """Candidates told with an image."""


class InOptuna:
    whole, warning = True, RuntimeWarning

    def __init__(self, kinds: Kinds, target: Any, **settings: Any) -> None:
        self.space = {name: self.distribution(kind) for name, kind in kinds.items()}
        given = {"seed": 0, "search_space": self.space, "proposer": "linear", **settings}
        self.sampler = FIDESampler(target, **given)
        self.study = optuna.create_study(sampler=self.sampler)

    @staticmethod
    def distribution(kind: Kind) -> BaseDistribution:
        if isinstance(kind, Choice):
            return CategoricalDistribution(kind.values)
        made: Any = IntDistribution if isinstance(kind, Int) else FloatDistribution
        distribution: BaseDistribution = made(kind.low, kind.high, log=kind.log)
        return distribution

    def ask(self) -> tuple[Any, Params]:
        trial = self.study.ask(fixed_distributions=self.space)
        return trial, {name: trial.params[name] for name in self.space}

    def tell(self, candidate: Any, loss: Any = None, **result: Any) -> None:
        if "image" in result:
            loss = self.sampler.tell_image(candidate, result["image"], loss)
        self.study.tell(candidate, loss)

    @property
    def images(self) -> int:
        return self.sampler.counts(self.study).get("image", 0)


class InNevergrad:
    whole, warning = False, NoImagesWarning

    def __init__(self, kinds: Kinds, target: Any, **settings: Any) -> None:
        space = ng.p.Dict(**{name: self.parameter(kind) for name, kind in kinds.items()})
        self.optimizer = ParametrizedFIDE(target=target, **{"seed": 0, **settings})(space, 1000)

    @staticmethod
    def parameter(kind: Kind) -> Any:
        if isinstance(kind, Choice):
            return ng.p.Choice(list(kind.values))
        made = (ng.p.Log if kind.log else ng.p.Scalar)(lower=kind.low, upper=kind.high)
        return made.set_integer_casting() if isinstance(kind, Int) else made

    def ask(self) -> tuple[Any, Params]:
        candidate = self.optimizer.ask()
        return candidate, dict(candidate.value)

    def tell(self, candidate: Any, loss: Any = None, **result: Any) -> None:
        if loss is None and "image" in result:
            self.optimizer.tell(candidate, result["image"])
        else:
            self.optimizer.tell(candidate, loss, **result)

    @property
    def images(self) -> int:
        return int(self.optimizer.num_images)


@pytest.fixture(params=[InOptuna, InNevergrad])
def adapter(request: pytest.FixtureRequest) -> type[Adapter]:
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    return request.param  # type: ignore[no-any-return]


# -- the same candidates ---------------------------------------------------------------------------


def core(
    adapter: type[Adapter], kinds: Kinds, target: Any, render: Any, **settings: Any
) -> Iterator[Params]:
    """Parameters that FIDE alone asks, which are told with their images."""
    opt = FIDE(Space(kinds), target, **{"seed": 0, "memory_mb": 0, **settings})
    while True:
        X = opt.ask(None if adapter.whole else 1)  # whole: without steps, which have other names
        asked = Space(kinds).decode_many(X)
        yield from asked
        images = [render(params) for params in asked]
        several = isinstance(images[0], list)
        opt.tell(X, [list(view) for view in zip(*images, strict=True)] if several else images)


def check_candidates(
    adapter: type[Adapter], kinds: Kinds, render: Any, target: Any, **settings: Any
) -> None:
    made = adapter(kinds, target, **settings)
    expected = core(adapter, kinds, target, render, **settings)
    for _ in range(50):
        candidate, params = made.ask()
        for name, value in next(expected).items():
            same = pytest.approx(value, abs=1e-9) if isinstance(value, float) else value
            assert params[name] == same, name
        made.tell(candidate, image=render(params))
    assert made.images == 50


MASK = np.pad(np.ones((SIZE, 4), np.float32), ((0, 0), (4, 0)))
PROBLEMS: dict[str, tuple[Kinds, Any, Params]] = {
    "floats": (FLOATS, disk, {}),
    "mixed": (MIXED, disk, {}),
    "fast": (FLOATS, disk, {"preset": "fast", "popsize": 12}),
    "mask": (FLOATS, disk, {"mask": MASK}),
    "views": (FLOATS, views, {"mask": [None, MASK[:, :5]], "popsize": 6}),
    "a range of values": (FLOATS, lambda p: 10 * disk(p) - 3, {"value_range": (-3, 17)}),
}


@pytest.mark.parametrize("what", PROBLEMS)
def test_it_asks_what_fide_asks(adapter: type[Adapter], what: str) -> None:
    kinds, render, settings = PROBLEMS[what]
    check_candidates(adapter, kinds, render, render(ANSWER), **settings)


@pytest.mark.filterwarnings("ignore::fide_adapters.nevergrad.NoImagesWarning")
@pytest.mark.filterwarnings("ignore:.*gets no images")
@pytest.mark.parametrize("target", [TARGET, None])
def test_without_images_it_is_cma_es(adapter: type[Adapter], target: Any) -> None:
    made = adapter(FLOATS, target)
    alone = FIDE(Space(FLOATS), TARGET, seed=0, proposer="none")
    for _ in range(100):
        candidate, params = made.ask()
        x = alone.ask(1)
        np.testing.assert_allclose(list(params.values()), x[0], rtol=0, atol=1e-12)
        loss = float(np.square(x - 0.3).sum())
        made.tell(candidate, loss)
        alone.tell(x, losses=[loss])


# -- images ----------------------------------------------------------------------------------------

BYTES = np.round(TARGET * 255).astype(np.uint8)
RGB = (BYTES / np.float32(255)).astype(np.float32)
FORMS: dict[str, Callable[[Path], Any]] = {
    "float64": lambda folder: RGB.astype(np.float64),
    "float32": lambda folder: RGB,
    "bytes": lambda folder: BYTES,
    "not contiguous": lambda folder: np.asfortranarray(BYTES),
    "a view": lambda folder: np.concatenate([BYTES, BYTES], axis=1)[:, SIZE:],
    "read-only": lambda folder: np.frombuffer(BYTES.tobytes(), np.uint8).reshape(BYTES.shape),
    "RGBA": lambda folder: np.dstack([BYTES, np.full((SIZE, SIZE), 255, np.uint8)]),
    "torch HWC": lambda folder: torch.from_numpy(RGB),
    "torch CHW": lambda folder: torch.from_numpy(RGB).permute(2, 0, 1),
    "PIL": lambda folder: Image.fromarray(BYTES),
    "nested lists": lambda folder: RGB.tolist(),
    "path": lambda folder: saved(folder / "a.png"),
    "text": lambda folder: str(saved(folder / "a.png")),
}


def saved(path: Path) -> Path:
    Image.fromarray(BYTES).save(path)
    return path


@pytest.mark.parametrize("form", FORMS)
def test_forms_of_images(adapter: type[Adapter], form: str, tmp_path: Path) -> None:
    """The loss is zero, so all pixels are those of the target."""
    made = adapter(FLOATS, RGB)
    losses = []
    for loss in (None, 0.5):
        candidate, _ = made.ask()
        made.tell(candidate, loss, image=FORMS[form](tmp_path))
        losses.append(best_of(made))
    assert losses == [pytest.approx(0, abs=1e-12)] * 2
    assert made.images == 2


def best_of(made: Any) -> float:
    if isinstance(made, InOptuna):
        return float(made.study.best_value)
    return float(made.optimizer.recommend().loss)


BAD: dict[str, tuple[Any, str]] = {
    "another size": (np.zeros((9, 8, 3)), r"8 x 8.*9 x 8.*float64"),
    "1 x 1": (np.zeros((1, 1, 3)), r"8 x 8.*1 x 1"),
    "2 channels": (np.zeros((SIZE, SIZE, 2)), r"1, 3 or 4 channels.*\(8, 8, 2\)"),
    "channels first": (np.zeros((3, SIZE, SIZE)), r"\(3, 8, 8\).*moveaxis"),
    "int64": (np.zeros((SIZE, SIZE, 3), np.int64), "uint8.*int64"),
    "NaN pixels": (np.full((SIZE, SIZE, 3), np.nan), "must be finite.*nan_to_num"),
    "a batch": (np.zeros((2, SIZE, SIZE, 3)), r"\(H, W\).*\(2, 8, 8, 3\)"),
    "no such path": ("/no/such/file.png", "/no/such/file.png"),
}


def check_refused(
    adapter: type[Adapter], error: type[Exception], message: str, loss: Any, **result: Any
) -> None:
    """The search goes on as if nothing had been told."""
    made, twin = adapter(FLOATS, TARGET), adapter(FLOATS, TARGET)
    (candidate, params), (other, _) = made.ask(), twin.ask()
    with pytest.raises(error, match=f"(?s){message}") as caught:
        made.tell(candidate, loss, **result)
    assert isinstance(caught.value, ValueError)
    if isinstance(made, InOptuna):
        assert "fide:image" not in made.study.trials[0].system_attrs
    for _ in range(10):
        made.tell(candidate, image=disk(params))
        twin.tell(other, image=disk(params))
        (candidate, params), (other, expected) = made.ask(), twin.ask()
        assert params == expected
    assert made.images == 10


@pytest.mark.parametrize("loss", [None, 0.5])
@pytest.mark.parametrize("what", BAD)
def test_what_is_no_image_changes_nothing(adapter: type[Adapter], what: str, loss: Any) -> None:
    image, message = BAD[what]
    check_refused(adapter, ImageError, message, loss, image=image)


def test_an_image_is_not_kept(adapter: type[Adapter]) -> None:
    made = adapter(FLOATS, TARGET)
    images: list[weakref.ref[Any]] = []
    for number in range(20):
        candidate, params = made.ask()
        image = disk(params)
        images.append(weakref.ref(image))
        made.tell(candidate, 0.5 if number % 2 else None, image=image)
        del image
    gc.collect()
    assert [ref() for ref in images] == [None] * 20


@pytest.mark.parametrize(
    ("given", "got"),
    [(np.zeros((20, 24, 3)), "ndarray"), ([np.zeros((20, 24))] * 3, "list")],
)
def test_other_images_than_one_for_each_view_are_refused(
    adapter: type[Adapter], given: Any, got: str
) -> None:
    made = adapter(FLOATS, views(ANSWER))
    rule = rf"render is a list of 2 images, one for each view, .*; got a {got} of another length$"
    with pytest.raises(ImageError, match=rule):
        made.tell(made.ask()[0], 0.1, image=given)


def test_images_beyond_black_and_white_are_clipped_with_one_warning(
    adapter: type[Adapter],
) -> None:
    made = adapter(FLOATS, TARGET)
    with pytest.warns(RuntimeWarning, match=r"clipped to \[0, 1\]") as caught:
        for _ in range(3):
            candidate, params = made.ask()
            made.tell(candidate, image=2 * disk(params) + 0.5)
    assert len(caught) == 1


@pytest.mark.parametrize("settings", [{"mask": MASK}, {"value_range": "auto"}])
def test_a_mask_and_a_range_belong_to_a_target(adapter: type[Adapter], settings: Params) -> None:
    with pytest.raises(ImageError, match="mask, weights and value_range belong to a target"):
        adapter(FLOATS, None, **settings)


# -- no images -------------------------------------------------------------------------------------


def test_a_target_without_images_is_warned_of_once(adapter: type[Adapter]) -> None:
    made = adapter(FLOATS, TARGET)
    with pytest.warns(adapter.warning, match=r"gets no images, so it is CMA-ES") as caught:
        for _ in range(30):
            made.tell(made.ask()[0], 1.0)
    assert len(caught) == 1


@pytest.mark.filterwarnings("ignore::fide_adapters.nevergrad.NoImagesWarning")
def test_without_a_target_options_of_the_network_mean_nothing(adapter: type[Adapter]) -> None:
    made = adapter(FLOATS, None, preset="paper", popsize=4)
    for _ in range(6):
        candidate, params = made.ask()
        made.tell(candidate, sum(params.values()))
    assert made.images == 0
