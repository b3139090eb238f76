"""Neural posterior estimation: the order of blocks, truncated proposals, the search."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from fide_lab import optimizers
from fide_lab.baselines.base import quietly
from fide_lab.baselines.npe import NPE, Flow, canonical, draw_truncated, seeded
from fide_plugins.errors import DependencyError, ImageError, OptionError
from fide_plugins.runtime.threads import one_thread
from fide_plugins.space import Float, Group, Space
from fide_plugins.types import Float32, Float64

from .small import OPTIONS

BLOCKS = np.array([[0, 1], [3, 4], [5, 6]])
TINY: dict[str, Any] = {**OPTIONS["npe"], "popsize": 40, "seed": 0}


@pytest.fixture
def sbi() -> Iterator[Any]:
    """The library, and one thread, as the optimizer computes with it."""
    with quietly():
        library = pytest.importorskip("sbi")
    with one_thread:
        yield library


def spot(X: Float64) -> Float32:
    """Images (n, 16, 16, 3) of a blurred spot at X (n, 2)."""
    at = np.linspace(0, 1, 16)
    rows = np.exp(-20 * (at - X[:, :1]) ** 2)
    columns = np.exp(-20 * (at - X[:, 1:2]) ** 2)
    image = rows[:, :, None] * columns[:, None, :]
    return np.repeat(image[..., None], 3, axis=3).astype(np.float32)


TARGET = spot(np.array([[0.3, 0.7]]))[0]


def test_the_order_of_blocks_is_forgotten_and_nothing_else() -> None:
    rng = np.random.default_rng(0)
    X = rng.random((50, 7))
    X[:10, BLOCKS[:, 0]] = 0.5  # equal: the second parameter decides
    shuffled = X.copy()
    for x in shuffled:
        x[BLOCKS] = x[rng.permutation(BLOCKS)]
    ordered = canonical(X, BLOCKS)
    np.testing.assert_array_equal(canonical(shuffled, BLOCKS), ordered)
    np.testing.assert_array_equal(ordered[:, 2], X[:, 2])
    assert (np.diff(ordered[:, BLOCKS[:, 0]], axis=1) >= 0).all()
    assert (np.diff(ordered[:10, BLOCKS[:, 1]], axis=1) >= 0).all()
    for x, y in zip(X, ordered, strict=True):
        assert {tuple(b) for b in x[BLOCKS].tolist()} == {tuple(b) for b in y[BLOCKS].tolist()}
    np.testing.assert_array_equal(canonical(X, None), X)


class Bell:
    """An estimator with the interface of sbi's: a normal distribution of any condition."""

    def __init__(self, dim: int, std: float, mean: float = 0.5) -> None:
        self.mean, self.std = torch.full((dim,), mean), std

    def sample(self, shape: tuple[int, ...], condition: Tensor) -> Tensor:
        return self.mean + self.std * torch.randn(*shape, 1, len(self.mean))

    def log_prob(self, theta: Tensor, condition: Tensor) -> Tensor:
        return -((theta - self.mean) / self.std).square().sum(dim=-1) / 2


def as_it_is(points: Tensor) -> Tensor:
    return points


@pytest.mark.parametrize("std", [0.15, 0.01], ids=["rejected", "resampled"])
def test_truncated_draws_are_uniform_where_the_posterior_has_its_mass(sbi: Any, std: float) -> None:
    """The region of a round bell in two dimensions is a disk: its radius is known."""
    from sbi.utils import BoxUniform

    quantile = 0.2
    flow = Flow(Bell(2, std), torch.zeros(1, 1), as_it_is)
    with seeded(1):
        prior = BoxUniform(torch.zeros(2), torch.ones(2))
        drawn = draw_truncated(4000, prior, flow, as_it_is, quantile, 10_000)
    edge = std * np.sqrt(-2 * np.log(quantile))
    radius = (drawn - 0.5).norm(dim=1)
    assert radius.max() < 1.05 * edge  # the threshold itself is an estimate
    # In a uniform disk the share of points within half of the radius is 1 / 4; of a bell's, 0.41.
    assert float((radius < edge / 2).double().mean()) == pytest.approx(0.25, abs=0.04)


def test_a_flow_that_leaks_is_clipped_and_takes_no_longer(sbi: Any) -> None:
    drawn = 0

    class Counted(Bell):
        def sample(self, shape: tuple[int, ...], condition: Tensor) -> Tensor:
            nonlocal drawn
            drawn += shape[0]
            return super().sample(shape, condition)

    outside = Flow(Counted(3, 0.1, mean=5.0), torch.zeros(1, 1), as_it_is)
    with seeded(0):
        points = outside.sample((100,))
    assert drawn == 200 and (points == 1.0).all()
    half = Flow(Bell(1, 1e-3, mean=0.0), torch.zeros(1, 1), as_it_is)
    with seeded(0):
        points = half.sample((1000,))
    assert ((points >= 0) & (points <= 1)).all()
    assert (points > 0).float().mean() > 0.9  # those in the box come first


def test_densities_that_are_no_numbers_are_none(sbi: Any) -> None:
    class Broken(Bell):
        def log_prob(self, theta: Tensor, condition: Tensor) -> Tensor:
            return torch.full(theta.shape[:-1], torch.nan)

    flow = Flow(Broken(2, 0.1), torch.zeros(1, 1), as_it_is)
    assert (flow.log_prob(torch.rand(5, 2)) == -torch.inf).all()
    from sbi.utils import BoxUniform

    with seeded(0):  # ends, though no point lies in the region
        prior = BoxUniform(torch.zeros(2), torch.ones(2))
        assert draw_truncated(10, prior, flow, as_it_is, 0.1, 100).shape == (10, 2)


@pytest.mark.thorough
def test_what_is_asked_comes_near_the_answer(sbi: Any) -> None:
    """A spot that shows both of its parameters: after two rounds it is known where it is."""
    options = {**TINY, "popsize": 90, "epochs": 9, "width": 20, "transforms": 2}
    opt = NPE(2, TARGET, **options | {"support": 500, "batch_size": 12})
    distances = []  # medians
    for _ in range(3):
        X = opt.ask()
        opt.tell(X, spot(X))
        distances.append(float(np.median(np.abs(X - [0.3, 0.7]).max(axis=1))))
    assert opt.trained == 2 and not opt._x
    assert distances[2] < 0.6 * distances[0]  # 0.10 to 0.23 times for six seeds


def test_candidates_of_exchangeable_blocks_have_one_order(sbi: Any) -> None:
    opt = NPE(4, TARGET, groups=[[0, 1], [2, 3]], **TINY)
    for i in range(3):
        X = opt.ask()
        if i:
            np.testing.assert_array_equal(canonical(X, np.array([[0, 1], [2, 3]])), X)
        opt.tell(X, spot(X))
    assert opt.trained == 2


def test_a_space_says_which_blocks_are_exchangeable(sbi: Any, tmp_path: Path) -> None:
    space = Space(spots=2 * Group(x=Float(0, 1), y=Float(0, 1)), z=Float(0, 1))
    opt = optimizers.make("npe", space, TARGET, **TINY)
    assert isinstance(opt, NPE) and opt.dim == 5
    assert opt.settings()["groups"] == space.largest_family
    opt.save(tmp_path / "c")
    assert NPE.load(tmp_path / "c").settings()["groups"] == space.largest_family
    assert optimizers.make("cma", space, TARGET).popsize > 0  # has no such option


def test_images_that_are_all_equal_teach_nothing_and_do_no_harm(sbi: Any) -> None:
    """The object is out of view."""
    opt = NPE(2, TARGET, **TINY)
    for _ in range(4):
        X = opt.ask()
        assert ((X >= 0) & (X <= 1)).all()
        opt.tell(X, np.zeros_like(spot(X)))
    assert len(np.unique(X, axis=0)) > 30


def test_points_without_a_loss_are_not_learned_from(sbi: Any) -> None:
    opt = NPE(2, TARGET, **TINY)
    X = opt.ask()
    losses = np.where(np.arange(40) < 25, np.nan, 1.0)
    opt.tell(X, spot(X), losses)
    assert opt.trained == 0 and len(opt._x) == 15  # too few
    X = opt.ask()
    opt.tell(X, spot(X), losses)
    assert opt.trained == 1 and len(opt._x) == 30


def test_a_training_makes_as_many_passes_as_it_may(
    sbi: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sbi.inference import NPE as Library

    passes = 0
    one = Library._train_epoch

    def counted(*args: Any) -> Any:
        nonlocal passes
        passes += 1
        return one(*args)

    monkeypatch.setattr(Library, "_train_epoch", counted)
    opt = NPE(2, TARGET, **{**TINY, "epochs": 3})
    X = opt.ask()
    opt.tell(X, spot(X))
    assert passes == 3


def test_nothing_is_written(
    sbi: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Neither what TensorBoard reads nor a message, also where a training ends by itself."""
    monkeypatch.chdir(tmp_path)
    opt = NPE(2, TARGET, **{**TINY, "epochs": 60})
    X = opt.ask()
    opt.tell(X, np.random.default_rng(0).random((40, 16, 16, 3)))  # nothing to learn: it ends soon
    assert opt.trained == 1 and not list(tmp_path.iterdir())
    assert capfd.readouterr() == ("", "")


def test_weights_of_another_network_are_refused(sbi: Any, tmp_path: Path) -> None:
    opt, other = NPE(2, TARGET, **TINY), NPE(2, TARGET, **{**TINY, "width": 8})
    for one in (opt, other):
        X = one.ask()
        one.tell(X, spot(X))
    state = opt.state_dict()
    with pytest.raises((ValueError, RuntimeError)):
        other.load_state_dict(state)
    assert len(other.ask()) == 40  # it goes on with its own


def test_without_sbi_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sbi", None)
    monkeypatch.setitem(sys.modules, "sbi.inference", None)
    with pytest.raises(DependencyError, match=r"npe .*pip install sbi .*extra sbi"):
        NPE(2, TARGET)


def test_it_needs_a_target() -> None:
    with pytest.raises(ImageError, match="needs a target"):
        NPE(2)


@pytest.mark.parametrize(
    "options",
    [
        {"budget": 0},
        {"share": 1.5},
        {"rounds": 0},
        {"epochs": 1},
        {"batch_size": 0},
        {"quantile": 0.0},
        {"quantile": 1.0},
        {"size": 8},
        {"width": 0},
        {"transforms": 0},
        {"support": 0},
        {"groups": [[0], [2]]},
    ],
    ids=str,
)
def test_options_out_of_range_are_named(sbi: Any, options: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=next(iter(options))):
        NPE(2, TARGET, **options)
