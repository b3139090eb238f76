"""Training of a network on renders, judged on renders held out, and its checkpoints."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from fide_plugins.errors import CheckpointError
from fide_plugins.learning.augmentation import augmented
from fide_plugins.learning.clutter import Clutter
from fide_plugins.learning.networks import Trainable, as_input
from fide_plugins.learning.renders import Pixels
from fide_plugins.runtime import checkpoint
from fide_plugins.runtime.devices import is_out_of_memory, repeatable
from fide_plugins.runtime.schema import IMPOSSIBLE
from fide_plugins.types import Float64, Indices, Mask

HELD_OUT, _MOST_HELD_OUT = 50, 2000  # every 50th render, and as many at most
_WARM_UP = 100  # steps
_BATCH = 32  # renders of a step: with more there are too few steps to leave the first plateaus
_PATIENCE = 4  # passes without a better held-out likelihood that end training
_STANDARD = 1000  # renders by which images are standardized
_CLIP = 5.0  # norm of a gradient
_BATCH_OF_TEST = 500
_AHEAD = 3  # batches that are made while others are learned from
_KIND = "training"
_T = TypeVar("_T")
_REMEDY = "delete this file, and it is trained again; the renders are kept"

Curve = list[list[float]]
"""Of each pass: renders seen so far, training and held-out loss.

The last pass is unfinished where the time was up.
"""
OnPass: TypeAlias = Callable[[int, float], None]
"""Called after every pass with how many there were, and the held-out loss of the last."""


def is_held_out(n: int) -> Mask:
    """Which of n renders judge, and are never learned from: (n,), at least one."""
    every: Mask = np.arange(n) % HELD_OUT == 0
    every[np.flatnonzero(every)[_MOST_HELD_OUT:]] = False
    return every


@dataclass
class Training:
    """Training of a network by AdamW (Loshchilov and Hutter 2019), a short warm-up and a cosine.

    A pass sees every training render once, in an order that depends on the seed and the pass alone,
    so that training goes on from a checkpoint as if it had not been interrupted.  At the end the
    network, changed in place on its device, has the weights of the lowest held-out loss.

    x, images: renders (n, d) and (n, H, W, 3).
    passes: at most.  seconds: at most, for the schedule too; None: no limit.
    augment, clutter: how images are changed in each pass; those that judge once by clutter alone.
    curve: see `Curve`.  passed: passes done.  spent: seconds.  best: lowest held-out loss.
    """

    network: Trainable
    x: Float64
    images: Pixels
    passes: int
    seed: int = 0
    seconds: float | None = None
    batch: int = _BATCH
    augment: str = "photograph"
    clutter: Clutter | None = None
    learning_rate: float = 1e-3
    curve: Curve = field(default_factory=list)
    passed: int = 0
    spent: float = 0.0
    best: float = math.inf

    def __post_init__(self) -> None:
        aside = is_held_out(len(self.x))
        self._train, self._test = np.flatnonzero(~aside), np.flatnonzero(aside)
        self._optimizer = torch.optim.AdamW(
            self.network.parameters(), lr=self.learning_rate, weight_decay=0.01, fused=True
        )
        self.network.standardize(as_input(self.shown(self._train[:_STANDARD])))  # not on a GPU
        self._judges = self.shown(self._test)
        self._best_weights = _copy(self.network)
        self._was_over = False

    def run(
        self,
        on_pass: OnPass = lambda passed, loss: None,
        save: Callable[[dict[str, Any]], None] = lambda state: None,
    ) -> None:
        """Train until passes or seconds are over, or nothing improves; save: after each pass."""
        n = len(self._train)
        while not self.over:
            start = time.monotonic()
            with repeatable(self.network.device):
                loss, seen = self._pass(start)
                test = self.test()
            self.curve.append([float(self.passed * n + seen), loss, test])
            self.passed += seen == n
            self.spent += time.monotonic() - start
            if test < self.best:
                self.best, self._best_weights = test, _copy(self.network)
            save(self.state_dict())
            on_pass(self.passed, test)
        self.network.load_state_dict(self._best_weights)

    @property
    def over(self) -> bool:
        """Whether training is complete, or was ended early."""
        held_out = [test for _, _, test in self.curve]
        stalled = bool(held_out) and len(held_out) - 1 - np.argmin(held_out) > _PATIENCE
        return self._was_over or self._late() or self.passed >= self.passes or bool(stalled)

    def _late(self, more: float = 0.0) -> bool:
        return self.seconds is not None and self.spent + more >= self.seconds

    def _pass(self, start: float) -> tuple[float, int]:
        """See every training render once, or until the time is up; mean loss, and how many."""
        rng = np.random.default_rng((self.seed, 2, self.passed))
        drawn = int(rng.integers(2**62))
        generator = torch.Generator(self.network.device).manual_seed(drawn)
        order = rng.permutation(self._train)
        total, seen = 0.0, 0
        with closing(_ahead(self._batches(order, drawn))) as batches:
            for images, u in batches:
                if seen and self._late(time.monotonic() - start):
                    break
                self._set_rate(seen, start)
                loss = self.network.loss(images, u, generator)
                self._step(loss)
                total, seen = total + float(loss.detach()) * len(u), seen + len(u)
        return total / max(1, seen), seen

    def _batches(self, order: Indices, drawn: int) -> Iterator[tuple[Tensor, Tensor]]:
        """Images (B, 3, H, W), changed, and parameters (B, d) of a pass; drawn: a seed."""
        generator = torch.Generator(self.network.device).manual_seed(drawn)
        for first in range(0, len(order), self.batch):
            some = np.sort(order[first : first + self.batch])
            images, u = self._batch(self.images[some], some)
            if self.clutter is not None:
                images = self.clutter.composed(images, generator)
            yield augmented(images, generator, self.augment), u

    def shown(self, rows: Indices) -> Pixels:
        """Images (n, H, W, 3) of some rows (n,), with clutter if there is some."""
        if self.clutter is None:
            return self.images[rows]
        return self.clutter.fixed(self.images, rows, self.seed)

    def _batch(self, images: Pixels, some: Indices) -> tuple[Tensor, Tensor]:
        """Images (B, C, H, W) and parameters (B, d) of some renders, where the network is."""
        device, u = self.network.device, torch.from_numpy(self.x[some].astype(np.float32))
        return as_input(images, device), u.to(device)

    def _step(self, loss: Tensor) -> None:
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), _CLIP)
        self._optimizer.step()

    def _set_rate(self, first: int, start: float) -> None:
        """Warm up, then follow half a cosine over the passes, or over the time if that is less."""
        done = (self.passed + first / max(1, len(self._train))) / self.passes
        if self.seconds is not None:
            spent = self.spent + time.monotonic() - start
            done = max(done, min(1.0, spent / self.seconds))
        step = (self.passed * len(self._train) + first) / self.batch
        rate = min(1.0, (step + 1) / _WARM_UP) * 0.5 * (1 + math.cos(math.pi * done))
        for group in self._optimizer.param_groups:
            group["lr"] = self.learning_rate * rate

    @torch.no_grad()
    def test(self) -> float:
        """Mean loss of held-out renders."""
        generator = torch.Generator(self.network.device).manual_seed(self.seed)
        total = 0.0
        for first in range(0, len(self._test), _BATCH_OF_TEST):
            some = self._test[first : first + _BATCH_OF_TEST]
            batch = self._batch(self._judges[first : first + _BATCH_OF_TEST], some)
            total += float(self.network.judged(*batch, generator)) * len(some)
        return total / max(1, len(self._test))

    # -- checkpoints -------------------------------------------------------------------------------

    def run_from(self, file: Path, plan: Mapping[str, Any], on_pass: OnPass) -> None:
        """As `run`, from the checkpoint in `file` if it is of this plan; it is kept up to date.

        Raises CheckpointError for a damaged file, OSError if it cannot be written.
        """
        if file.exists():
            try:
                saved = checkpoint.read(file, _KIND)
                if saved["plan"] == plan:
                    self.load_state_dict(saved["state"])
            except (*IMPOSSIBLE, CheckpointError) as error:
                if is_out_of_memory(error):
                    raise
                why = f"{file}: damaged, or no training ({error!r}); {_REMEDY}"
                raise CheckpointError(why) from error

        def save(state: dict[str, Any]) -> None:
            checkpoint.write(file, _KIND, {"plan": dict(plan), "state": state})

        self.run(on_pass, save)

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes, as nested dicts of arrays and numbers."""
        moments = self._optimizer.state_dict()["state"]
        return {
            **{name: getattr(self, name) for name in ("passed", "spent", "over", "curve", "best")},
            "weights": _copy(self.network),
            "best_weights": self._best_weights,
            "moments": {str(i): dict(entry) for i, entry in moments.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put back what `state_dict` gave; raises errors of PyTorch for what does not fit."""
        self.network.load(state["weights"])
        self._best_weights = {k: torch.as_tensor(v) for k, v in state["best_weights"].items()}
        self.passed, self.spent, self._was_over = state["passed"], state["spent"], state["over"]
        self.curve, self.best = [list(row) for row in state["curve"]], state["best"]
        whole, weights = self._optimizer.state_dict(), list(self.network.parameters())
        whole["state"] = {
            int(i): {name: _like(weights[int(i)], value) for name, value in entry.items()}
            for i, entry in state["moments"].items()
        }
        self._optimizer.load_state_dict(whole)


def _ahead(batches: Iterator[_T]) -> Generator[_T, None, None]:
    """As they come, but made in a thread, while those before are learned from."""
    with ThreadPoolExecutor(1) as thread:
        waiting = [thread.submit(next, batches, None) for _ in range(_AHEAD)]
        while (one := waiting.pop(0).result()) is not None:
            waiting.append(thread.submit(next, batches, None))
            yield one


def _copy(network: nn.Module) -> dict[str, Tensor]:
    return {
        name: value.detach().to("cpu", copy=True) for name, value in network.state_dict().items()
    }


def _like(weight: Tensor, value: Any) -> Tensor:
    """Return a moment in the memory layout of its weight, which the optimizer takes for granted."""
    moment = torch.as_tensor(value)
    return moment if moment.ndim == 0 else torch.empty_like(weight).copy_(moment).detach()
