"""A user's optimizer by reference: the protocol, its errors, saving."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab import optimizers
from fide_lab.baselines.evolution import CMA
from fide_plugins.errors import CheckpointError, ImageError, OptionError, PointsError

TARGET = np.full((4, 4, 3), 0.3, np.float32)
MINE = """
import numpy as np
from fide_lab.baselines.evolution import CMA


class Least:
    def __init__(self, dim, seed):
        self.cma, self.told = CMA(dim, seed=seed, popsize=6), []
        self.popsize = 6

    def ask(self, n):
        return self.cma.ask(n)

    def tell(self, X, losses):
        self.told.append((X, losses))
        self.cma.tell(X, losses=losses)


class Images(Least):
    def __init__(self, dim, target, seed=0, budget=1, gain=2.0):
        super().__init__(dim, seed)
        self.target, self.budget, self.gain = target, budget, gain

    def tell(self, X, images, losses):
        self.images = images
        super().tell(X, losses)

    def recommend(self):
        return np.full(3, 0.25)


class Last(Images):
    def tell(self, X, losses, images=None):
        super().tell(X, images, losses)


class Unseeded:
    def __init__(self, dim):
        self.dim = dim

    def ask(self, n):
        return np.random.default_rng().random((n, self.dim))

    def tell(self, X, losses):
        pass


class Global(Unseeded):
    def ask(self, n):
        return np.random.random((n, self.dim))


class Few(Unseeded):
    def ask(self, n):
        return np.zeros((n - 1, self.dim))


class Deaf:
    def __init__(self, dim): ...
    def ask(self, n): ...


class Strange(Least):
    def __init__(self, dim, budgets): ...


class Nowhere(Least):
    def __init__(self, seed): ...


class Narrow(Least):
    def tell(self, X): ...


class Recommends(Least):
    def __init__(self, dim, seed, kind="far"):
        super().__init__(dim, seed)
        self.kind, self.recommended = kind, 0

    def recommend(self):
        self.recommended += 1
        points = {"far": [1.7, 0, 0], "short": [0, 0], "none": None, "nan": [np.nan, 0, 0]}
        return points.get(self.kind, [0.25, 0, 1])


def made(dim, seed):
    return Least(dim, seed)


def empty(dim):
    return object()


number = 3
"""


@pytest.fixture(autouse=True)
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(MINE)


def test_it_searches_as_what_it_calls() -> None:
    opt, cma = (optimizers.make("mine.py:Least", 3, seed=5), CMA(3, seed=5, popsize=6))
    assert opt.name == "mine.py:Least" and opt.popsize == 6
    for _ in range(4):
        X = opt.ask()
        np.testing.assert_array_equal(X, cma.ask())
        losses = ((X - 0.3) ** 2).sum(1)
        opt.tell(X[4:], losses=losses[4:])  # pieces, and out of order
        opt.tell(X[:4], losses=losses[:4])
        cma.tell(X, losses=losses)
    assert opt.best is not None and opt.best.loss == cma.best.loss  # type: ignore[union-attr]
    np.testing.assert_array_equal(opt.recommend(), opt.best.x)


@pytest.mark.parametrize("name", ["Images", "Last"])
def test_it_gets_what_it_names_and_whole_generations(name: str) -> None:
    opt: Any = optimizers.make(f"mine.py:{name}", 3, TARGET, seed=1, budget=77, gain=3.0)
    user = opt._user
    assert (user.budget, user.gain) == (77, 3.0)
    np.testing.assert_array_equal(user.target, TARGET)
    X, images = opt.ask(), np.random.default_rng(0).random((6, 4, 4, 3)).astype(np.float32)
    losses = np.arange(6.0)
    losses[2] = np.nan
    for part in (slice(3, 6), slice(0, 3)):
        opt.tell(X[part], images[part], losses[part])
    ((told, values),) = user.told
    np.testing.assert_array_equal(told, X)
    np.testing.assert_array_equal(user.images, images)
    assert values[2] == np.inf and values[5] == 5.0
    np.testing.assert_array_equal(opt.recommend(), 0.25)
    with pytest.raises(ImageError, match="learns from images"):
        opt.tell(opt.ask(), losses=losses)


@pytest.mark.parametrize("name", ["Least", "Global", "made"])
def test_it_is_saved_as_its_history(name: str, tmp_path: Path) -> None:
    reference = f"mine.py:{name}"
    opt = optimizers.make(reference, 3, seed=5)
    for count in (opt.popsize, opt.popsize, 2):
        X = opt.ask()[:count]
        opt.tell(X, losses=X.sum(1))
    opt.save(tmp_path / "c")
    again = optimizers.load(reference, tmp_path / "c")
    for _ in range(2):
        X = opt.ask()
        np.testing.assert_array_equal(again.ask(), X)
        for each in (opt, again):
            each.tell(X, losses=X.sum(1))


@pytest.mark.parametrize(
    ("name", "message"), [("Unseeded", "asks for other candidates"), ("Images", "from images")]
)
def test_what_cannot_be_run_again_says_so(name: str, message: str, tmp_path: Path) -> None:
    opt = optimizers.make(f"mine.py:{name}", 3, TARGET, seed=5)
    X = opt.ask()
    opt.tell(X, np.zeros((len(X), 4, 4, 3)), X.sum(1))
    opt.save(tmp_path / "c")
    with pytest.raises(CheckpointError, match=message):
        optimizers.load(f"mine.py:{name}", tmp_path / "c")


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ("mine.py:Deaf", "has no method tell; give it tell(X, losses) or tell(X, images, losses)"),
        ("mine.py:Strange", "it needs 'budgets' too: (dim, budgets); give other parameters a def"),
        ("mine.py:Nowhere", "must have a parameter dim"),
        ("mine.py:Narrow", "tell of mine.py:Narrow must be tell(X, losses) or"),
        (
            "mine.py:number",
            "'number' in mine.py must be a class with ask and tell; it has Least, Images",
        ),
        ("mine.py:Leest", "'Leest' in mine.py must be a class with ask and tell; it has Least"),
        ("mine.py", "; it has Least, Images"),
        ("nowhere.py:Search", "no file 'nowhere.py'; write FILE.py:NAME or module:NAME"),
        ("nevergard:CMA", "no module 'nevergard'; write FILE.py:NAME"),
        ("mine.py:empty", "mine.py:empty has no method ask"),
    ],
)
def test_the_protocol_is_checked_when_it_is_named(reference: str, message: str) -> None:
    with pytest.raises(OptionError, match=re.escape(message)):
        optimizers.make(reference, 2)


def test_options_are_those_of_the_constructor() -> None:
    assert optimizers.options("mine.py:Images") == ["budget", "gain", "loss", "seed"]
    with pytest.raises(OptionError, match="has no option 'popsize'; its options: budget, gain"):
        optimizers.make("mine.py:Images", 2, popsize=4)


def test_too_few_candidates() -> None:
    with pytest.raises(PointsError, match=r"must return candidates of shape \(6, 2\).* 5 rows"):
        optimizers.make("mine.py:Few", 2).ask()


@pytest.mark.parametrize("kind", ["far", "short", "none", "nan"])
def test_a_wrong_recommendation_fails_after_the_first_generation(kind: str) -> None:
    opt = optimizers.make("mine.py:Recommends", 3, seed=0, kind=kind)
    X = opt.ask()
    opt.tell(X[:5], losses=X[:5].sum(1))
    with pytest.raises(PointsError, match=r"recommend\(\) of .* must return .* shape \(3,\) in "):
        opt.tell(X[5:], losses=X[5:].sum(1))
