"""Training of a network on renders, judged on renders held out, and its checkpoints.

AdamW with a short warm-up and a cosine schedule (Loshchilov and Hutter 2019, arXiv:1711.05101).  A
pass sees every training render once, in an order that depends on the seed and the pass alone, so
that training goes on from a checkpoint as if it had not been interrupted.  The weights of the pass
with the lowest held-out loss are kept: of a `Network` the negative log-likelihood in nats, of an
`Emulator` the share of the images' variance that it does not explain.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

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

Curve = list[list[float]]
"""Of each pass: renders seen so far, training and held-out loss.

The last pass is unfinished where the time was up.
"""


@dataclass(frozen=True)
class Progress:
    """What a caller is told while training: pass, passes, and the losses of the last pass."""

    passed: int
    passes: int
    training: float
    held_out: float


def is_held_out(n: int) -> Mask:
    """Which of n renders judge, and are never learned from: (n,), at least one."""
    every: Mask = np.arange(n) % HELD_OUT == 0
    every[np.flatnonzero(every)[_MOST_HELD_OUT:]] = False
    return every


@dataclass
class Training:
    """Training of a network.

    network: changed in place, on its device; at the end it has the best weights.  An emulator needs
        images as they are: augment="none".
    x, images: renders (n, d) and (n, H, W, 3).
    passes: at most.  seconds: at most, for the schedule too; None: no limit.
    augment: how much images are changed, see `augmentation`.
    clutter: what renders are composed with, anew in each pass; those that judge once.
    curve: see `Curve`.  passed: passes done.  spent: seconds that they took.
    extended: whether a longer schedule, or more time, took the place of one that was over.  It is
        not ended early: its rate is high again, and held-out renders are better only when it has
        fallen.
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
    extended: bool = False

    def __post_init__(self) -> None:
        aside = is_held_out(len(self.x))
        self._train, self._test = np.flatnonzero(~aside), np.flatnonzero(aside)
        self._optimizer = torch.optim.AdamW(
            self.network.parameters(), lr=self.learning_rate, weight_decay=0.01, fused=True
        )
        self.network.standardize(as_input(self.shown(self._train[:_STANDARD])))  # not on a GPU
        self._judges = self.shown(self._test)
        self._best, self._best_weights = math.inf, _copy(self.network)

    def run(
        self,
        on_pass: Callable[[Progress], None] | None = None,
        save: Callable[[dict[str, Any]], None] | None = None,
    ) -> None:
        """Train until the passes or the seconds are over, or nothing improves.

        on_pass: called after every pass.  save: called with `state_dict()` after every pass.
        """
        n = len(self._train)
        if not self.over and self.curve and self.curve[-1][0] > self.passed * n:
            self.curve.pop()  # the unfinished pass begins again
        while not self.over:
            start = time.monotonic()
            with repeatable(self.network.device):
                loss, seen = self._pass(start)
                test = self.test()
            self.curve.append([float(self.passed * n + seen), loss, test])
            self.passed += seen == n
            self.spent += time.monotonic() - start
            if test < self._best:
                self._best, self._best_weights = test, _copy(self.network)
            if save is not None:
                save(self.state_dict())
            if on_pass is not None:
                on_pass(Progress(self.passed, self.passes, loss, test))
        self.network.load_state_dict(self._best_weights)

    @property
    def over(self) -> bool:
        """Whether training is complete, or was ended early."""
        stalled = not self.extended and self.passed - self._best_pass > _PATIENCE
        return self._late() or self.passed >= self.passes or stalled

    @property
    def best(self) -> float:
        """Lowest held-out loss of a pass; +inf before the first."""
        return self._best

    @property
    def _best_pass(self) -> int:
        """Pass, from 1, that was the best on held-out renders; 0 before the first."""
        if not self.curve:
            return 0
        best = min(self.curve, key=lambda row: row[2])
        return math.ceil(best[0] / len(self._train))

    def _late(self, more: float = 0.0) -> bool:
        return self.seconds is not None and self.spent + more >= self.seconds

    def _pass(self, start: float) -> tuple[float, int]:
        """See every training render once; returns the mean loss, and how many were seen.

        They are fewer than all if the time is up: the rate is zero from then on.
        """
        rng = np.random.default_rng((self.seed, 2, self.passed))
        generator = torch.Generator(self.network.device).manual_seed(int(rng.integers(2**62)))
        order = rng.permutation(self._train)
        total, seen = 0.0, 0
        for first in range(0, len(order), self.batch):
            if first and self._late(time.monotonic() - start):
                break
            some = np.sort(order[first : first + self.batch])
            self._set_rate(first, start)
            images, u = self._batch(self.images[some], some)
            if self.clutter is not None:
                images = self.clutter.composed(images, generator)
            images = augmented(images, generator, self.augment)
            loss = self.network.loss(images, u, generator)
            self._step(loss)
            total, seen = total + float(loss.detach()) * len(some), seen + len(some)
        return total / max(1, seen), seen

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

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes, as nested dicts of arrays and numbers."""
        moments = self._optimizer.state_dict()["state"]
        return {
            "passed": self.passed,
            "spent": self.spent,
            "extended": self.extended,
            "over": self.over,
            "curve": self.curve,
            "best": self._best,
            "weights": _copy(self.network),
            "best_weights": self._best_weights,
            "moments": {str(i): dict(entry) for i, entry in moments.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put back what `state_dict` gave; raises errors of PyTorch for what does not fit."""
        self.network.load(state["weights"])
        self._best_weights = {k: torch.as_tensor(v) for k, v in state["best_weights"].items()}
        self.passed, self.spent = state["passed"], state["spent"]
        self.extended = state["extended"]
        self.curve, self._best = [list(row) for row in state["curve"]], state["best"]
        whole, weights = self._optimizer.state_dict(), list(self.network.parameters())
        whole["state"] = {
            int(i): {name: _like(weights[int(i)], value) for name, value in entry.items()}
            for i, entry in state["moments"].items()
        }
        self._optimizer.load_state_dict(whole)


def _copy(network: nn.Module) -> dict[str, Tensor]:
    return {
        name: value.detach().to("cpu", copy=True) for name, value in network.state_dict().items()
    }


def _like(weight: Tensor, value: Any) -> Tensor:
    """Return a moment in the memory layout of its weight, which the optimizer takes for granted."""
    moment = torch.as_tensor(value)
    return moment if moment.ndim == 0 else torch.empty_like(weight).copy_(moment).detach()


# -- checkpoints -----------------------------------------------------------------------------------


_KIND = "training"
_REMEDY = "delete this file, and it is trained again; the renders are kept"


@dataclass(frozen=True)
class Resumable:
    """A training of `plan`, kept in `file`."""

    file: Path
    plan: dict[str, Any]

    def run(
        self, training: Training, on_pass: Callable[[Progress], None], *, over: bool = False
    ) -> None:
        """Train from the checkpoint, if it is of this plan, and keep it up to date.

        over: whether a training that was over stays so, also where there is more time now.

        Raises CheckpointError for a damaged file, OSError if it cannot be written.
        """

        def save(state: dict[str, Any]) -> None:
            checkpoint.write(self.file, _KIND, {"plan": self.plan, "state": state})

        saved = self._saved()
        if saved is not None:
            self._restore(training, saved, over)
        else:
            save(training.state_dict())  # the first pass may be interrupted, too
        training.run(on_pass, save)

    @property
    def interrupted(self) -> bool:
        """Whether a training of this very plan has begun and is not over."""
        saved = self._saved()
        if saved is None or saved["plan"]["passes"] != self.plan["passes"]:
            return False
        state = saved.get("state")
        return isinstance(state, dict) and not state.get("over", True)

    def _saved(self) -> dict[str, Any] | None:
        """Contents of the file; None where it is missing, or another plan's of no use here.

        Raises CheckpointError for a damaged file.
        """
        if not self.file.exists():
            return None
        try:
            saved = checkpoint.read(self.file, _KIND)
        except CheckpointError as error:
            raise CheckpointError(f"{self.file}: damaged, or no training; {_REMEDY}") from error
        there = saved.get("plan", {})
        passes = there.get("passes")
        if not isinstance(passes, int) or passes > self.plan["passes"]:
            return None
        return saved if {**there, "passes": self.plan["passes"]} == self.plan else None

    def _restore(self, training: Training, saved: dict[str, Any], over: bool) -> None:
        passes = saved["plan"]["passes"]
        try:
            training.load_state_dict(saved["state"])
            was_over = saved["state"]["over"]
            if was_over and over:
                training.seconds = 0.0
            longer = self.plan["passes"] > passes
            training.extended |= was_over and (longer or not training.over)
        except IMPOSSIBLE as error:
            if is_out_of_memory(error):
                raise
            raise CheckpointError(
                f"{self.file}: impossible contents ({error!r}); {_REMEDY}"
            ) from error
