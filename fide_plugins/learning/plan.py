"""How a model is made: renders, the trainings, and the report of how good it is."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fide_plugins.errors import DeviceMemoryError, OptionError
from fide_plugins.learning.judging.finishing import familiarity_of, report_of
from fide_plugins.learning.judging.report import Distance
from fide_plugins.learning.model import Model
from fide_plugins.learning.networks.emulator import Emulator
from fide_plugins.learning.networks.network import Network
from fide_plugins.learning.renders.identity import check_images
from fide_plugins.learning.renders.renderer import BatchRenderer, Pixels, pixels_of
from fide_plugins.learning.renders.rendering import check_workers, fill
from fide_plugins.learning.renders.store import RenderStore, check_room
from fide_plugins.learning.renders.tally import all_equal, too_few
from fide_plugins.learning.training.one_training import Progress, Training
from fide_plugins.learning.training.resumable import Resumable
from fide_plugins.learning.truncation import Truncated
from fide_plugins.runtime.devices import is_out_of_gpu_memory
from fide_plugins.runtime.messages import warn_user
from fide_plugins.runtime.registry import fingerprint_of
from fide_plugins.types import Float64

__all__ = ["FEWEST", "LearnProgress", "Plan"]

FEWEST = 100
"""Renders that are needed."""
_RENDERING = 0.5  # of a time limit, at most
_DENSITY = 0.75  # of a time limit, until the emulator is trained, if there is one
_EMULATOR_RATE = 2e-3


@dataclass(frozen=True)
class LearnProgress:
    """What `learn` says of its progress.

    stage: "render", "train", "emulate", "calibrate" or "judge".
    done, total: renders, passes, or held-out pictures.  A picture calibrates once for each scale
        that is tried; total is then the most there may be, and calibrating may end before it.
    held_out: loss after the last pass: negative log-likelihood in nats, or the share of the images'
        variance that the emulator does not explain; None in the other stages.
    """

    stage: str
    done: int
    total: int
    held_out: float | None = None


@dataclass(frozen=True)
class Plan:
    """All that is decided before anything is rendered.

    shape, size: (H, W) of an image, and of what the network sees.
    seconds, start: time limit, and the monotonic clock when it began; None: no limit.
    emulates: whether a learned renderer is trained, too.
    region: where a second round renders; None for a first one.
    The rest: arguments of `pipeline.learn`, checked.
    """

    renderer: BatchRenderer
    shape: tuple[int, int]
    size: tuple[int, int]
    renders: int
    passes: int
    workers: int
    executor: object
    seed: int
    version: str | None
    head: str
    blocks: tuple[tuple[int, ...], ...]
    seconds: float | None
    start: float
    on_progress: Callable[[LearnProgress], None]
    augment: str
    device: torch.device
    emulates: bool
    region: Truncated | None = None

    def check(self, store_limit: float) -> None:
        """Raise OptionError where it cannot be carried out; store_limit: GiB of renders."""
        self._check_region()
        if self.workers > 1 or self.executor is not None:
            check_workers(self.renderer, self.workers, self.executor)
        check_room(self.settings, self.renders, store_limit * 2**30)

    def _check_region(self) -> None:
        """Raise OptionError where the renders of a first round do not fit this one."""
        if self.region is None:
            return
        self.region.model.check_space(self.renderer.space or self.renderer.dim)
        there = self.region.store.settings
        for name in ("renderer", "size", "version"):
            first = name == "version" and there[name] is None  # stated now: images are compared
            if there[name] != self.settings[name] and not first:
                raise OptionError(
                    f"the {name} of the model is {there[name]!r}, and here {self.settings[name]!r}"
                    ": both rounds must have the same"
                )

    @property
    def settings(self) -> dict[str, Any]:
        """What the renders are of."""
        space = self.renderer.space
        return {
            **({} if self.region is None else self.region.settings),
            "dim": self.renderer.dim,
            "size": list(self.size),
            "seed": self.seed,
            "renderer": self.renderer.name,
            "version": self.version,
            "space": None if space is None else space.to_dict(),
        }

    def model(self, store: RenderStore) -> Model:
        """Render, train and judge."""
        more = bool(store.missing(self.renders))
        for there in [store] if self.region is None else [self.region.store, store]:
            check_images(there, self.renderer, more)
        fill(
            store,
            self.renderer,
            self.renders,
            workers=self.workers,
            executor=self.executor,
            seconds=self._left(_RENDERING),
            on_progress=lambda n: self.on_progress(LearnProgress("render", n, self.renders)),
        )
        x, images = store.read(self.renders)
        failed = store.failed(self.renders)
        if len(x) < FEWEST:
            store.remove([*failed])  # so that a renderer that was mended renders them
            raise too_few(len(x), FEWEST, sum(failed.values()), self.renders)
        if self.region is not None:
            earlier = self.region.renders()
            x, images = np.concatenate([earlier[0], x]), np.concatenate([earlier[1], images])
        if all(np.array_equal(image, images[0]) for image in images):
            store.remove_image(images[0])
            raise all_equal(self.renderer.name, len(images))
        with _enough_memory(self.device):
            network, density = self._density(x, images, store.folder)
            emulator, emulated = self._emulator(x, images, store.folder)
        report = report_of(
            network, density, Distance(np.array(self.renderer.periodic), self.blocks), self._names,
            failed=sum(failed.values()), emulated=emulated,
            on_progress=lambda *at: self.on_progress(LearnProgress(*at)),
        )  # fmt: skip
        return Model(
            network=network, space=self.renderer.space, shape=self.shape,
            renderer=self.renderer.name, version=self.version, head=self.head,
            periodic=self.renderer.periodic, blocks=self.blocks,
            familiarity=familiarity_of(network, images), report=report,
            fingerprint=fingerprint_of(self.renderer.source), emulator=emulator,
            picture=None if self.region is None else pixels_of(self.region.picture, self.size),
        )  # fmt: skip

    @torch.inference_mode(False)  # the caller may be in it, or in `no_grad`
    @torch.enable_grad()
    def _density(self, x: Float64, images: Pixels, folder: Path) -> tuple[Network, Training]:
        """Trained network, and its training."""
        network = Network(self.size, self.renderer.periodic, self.head, self.blocks, self.seed)
        left = self._left(_DENSITY if self.emulates else 1.0)
        training = Training(
            network.to(self.device), x, images, self.passes, self.seed, left, augment=self.augment
        )
        over = self.emulates and self._resumable(folder, "emulator", len(x)).interrupted
        self._resumable(folder, "training", len(x)).run(training, self._say("train"), over=over)
        network.to("cpu").eval()
        return network, training

    @torch.inference_mode(False)
    @torch.enable_grad()
    def _emulator(
        self, x: Float64, images: Pixels, folder: Path
    ) -> tuple[Emulator | None, float | None]:
        """Learned renderer, and the share of variance that it explains; None, if there is none."""
        if not self.emulates:
            return None, None
        emulator = Emulator(self.size, self.renderer.periodic, self.blocks, self.seed)
        training = Training(
            emulator.to(self.device), x, images, self.passes, self.seed, self._left(),
            augment="none", learning_rate=_EMULATOR_RATE,
        )  # fmt: skip
        self._resumable(folder, "emulator", len(x)).run(training, self._say("emulate"))
        if not math.isfinite(training.best):
            warn_user(
                "the training of the emulator has diverged, and the model has none: learn with "
                "another seed, or with emulator=False"
            )
            return None, None
        return emulator.to("cpu").eval(), 1 - training.best

    def _resumable(self, folder: Path, name: str, renders: int) -> Resumable:
        """What a training is kept as, name: "training" (of the density) or "emulator"."""
        own = name == "emulator"
        plan = {
            "renders": renders, "passes": self.passes, "head": name if own else self.head,
            "seed": self.seed, "augment": "none" if own else self.augment,
            "blocks": [list(block) for block in self.blocks],
        }  # fmt: skip
        return Resumable(folder / name, plan)

    def _say(self, stage: str) -> Callable[[Progress], None]:
        """What a training calls after each pass."""
        return lambda at: self.on_progress(LearnProgress(stage, at.passed, at.passes, at.held_out))

    def _left(self, share: float = 1.0) -> float | None:
        """Seconds until a share of the time has passed since the beginning; None: no limit."""
        if self.seconds is None:
            return None
        left = share * self.seconds - (clock.monotonic() - self.start)
        return max(left, min(1e-3, share * self.seconds))

    @property
    def _names(self) -> list[str]:
        """Of the axes."""
        space = self.renderer.space
        if space is None:
            return [f"x[{i}]" for i in range(self.renderer.dim)]
        return [name for name, axes in space.axes.items() for _ in axes]


@contextmanager
def _enough_memory(device: torch.device) -> Iterator[None]:
    """Raise DeviceMemoryError where what is done inside needs more memory than a GPU has."""
    try:
        yield
    except RuntimeError as error:
        if device.type == "cpu" or not is_out_of_gpu_memory(error):
            raise
        raise DeviceMemoryError(
            f"{device} has too little memory for training ({error}); take device='cpu', or end "
            "what else needs that memory"
        ) from error
