"""`learn`: its arguments are checked, a plan is made of them and carried out."""

from __future__ import annotations

import math
import os
import time as clock
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fide_plugins.errors import DeviceMemoryError, OptionError
from fide_plugins.learning.augmentation import AUGMENT, check_installed
from fide_plugins.learning.clutter import Clutter, clutter_of
from fide_plugins.learning.emulator import Emulator
from fide_plugins.learning.judging import familiarity_of, report_of
from fide_plugins.learning.model import Model
from fide_plugins.learning.networks import Network
from fide_plugins.learning.rendering import all_equal, fill, pool_for, too_few
from fide_plugins.learning.renders import (
    BatchRenderer,
    Pixels,
    RenderStore,
    as_renderer,
    folder_of,
    small_size,
)
from fide_plugins.learning.training import OnPass, Training
from fide_plugins.runtime.devices import is_out_of_gpu_memory, resolve_device
from fide_plugins.runtime.messages import warn_user
from fide_plugins.runtime.registry import fingerprint_of
from fide_plugins.runtime.threads import user_threads
from fide_plugins.space import Space
from fide_plugins.types import Float64
from fide_plugins.validation.options import one_of, seconds_of
from fide_plugins.validation.points import torch_seed, whole_number

FEWEST = 100
"""Renders that are needed."""
_RENDERING = 0.5  # of a time limit, at most
_DENSITY = 0.75  # of a time limit, until the emulator is trained, if there is one
_EMULATOR_RATE = 2e-3


def blocks_of(renderer: BatchRenderer, groups: Sequence[Sequence[int]] | None) -> list[list[int]]:
    """Exchangeable blocks of axes, see `learn`; raises OptionError for what are none."""
    from fide_plugins.search.scene import check_groups

    if groups is None:
        own = [] if renderer.space is None else renderer.space.largest_family
        return [list(block) for block in own]
    if hasattr(groups, "__len__") and len(groups) == 0:
        return []
    blocks: list[list[int]] = check_groups(groups, renderer.dim).tolist()
    wraps = np.array(renderer.periodic)[np.array(blocks, np.intp)]
    for i in np.flatnonzero((wraps != wraps[:1]).any(axis=0)):
        raise OptionError(
            f"groups must be alike: of {[block[i] for block in blocks]}, which have one place in "
            "their groups, all parameters must be periodic, or none"
        )
    return blocks


def has_emulator(emulator: bool | None, blocks: Sequence[Sequence[int]], clutter: bool) -> bool:
    """Whether a learned renderer is trained; None: where there are exchangeable blocks."""
    if emulator and not blocks:
        raise OptionError("an emulator needs exchangeable blocks: give groups")
    if emulator and clutter:
        raise OptionError("an emulator imitates renders without clutter: leave out one of the two")
    return bool(blocks) and not clutter if emulator is None else emulator


@dataclass(frozen=True)
class LearnProgress:
    """What `learn` says of its progress.

    stage: "render", "train", "emulate" or "judge".
    done, total: renders, passes, or held-out pictures.
    held_out: loss after the last pass: negative log-likelihood in nats, or the share of the images'
        variance that the emulator does not explain; None in the other stages.
    """

    stage: str
    done: int
    total: int
    held_out: float | None = None


@dataclass(frozen=True)
class _Plan:
    """All that is decided before anything is rendered: arguments of `learn`, checked."""

    renderer: BatchRenderer
    shape: tuple[int, int]
    size: tuple[int, int]
    renders: int
    passes: int
    workers: int
    seed: int
    blocks: list[list[int]]
    seconds: float | None
    start: float
    on_progress: Callable[[LearnProgress], None]
    augment: str
    device: torch.device
    emulates: bool
    clutter: Clutter | None

    def model(self, folder: Path) -> Model:
        """Render, train and judge."""
        x, images, failed = self._renders(folder)
        # the caller may be in inference mode, or in `no_grad`
        with _enough_memory(self.device), torch.inference_mode(False), torch.enable_grad():
            network, density = self._density(x, images, folder)
            emulator, emulated = self._emulator(x, images, folder)
        of, space = self.renderer, self.renderer.space
        numbered = [f"x[{i}]" for i in range(of.dim)]
        names = [one for one, axes in space.axes.items() for _ in axes] if space else numbered
        report = report_of(
            network, density, names, failed=failed, emulated=emulated,
            on_picture=lambda *at: self.on_progress(LearnProgress("judge", *at)),
        )  # fmt: skip
        return Model(
            network=network, space=space, shape=self.shape, renderer=of.name, version=of.version,
            familiarity=familiarity_of(network, density), report=report,
            fingerprint=fingerprint_of(of.source), emulator=emulator,
        )  # fmt: skip

    def _renders(self, folder: Path) -> tuple[Float64, Pixels, int]:
        """Parameters (n, d) and images (n, H, W, 3), and how many renders have failed."""
        of = self.renderer
        settings = {
            **({"coverage": True} if of.coverage else {}),
            "dim": of.dim, "size": list(self.size), "seed": self.seed, "renderer": of.name,
            "version": of.version, "space": None if of.space is None else of.space.to_dict(),
        }  # fmt: skip
        store = RenderStore(folder, settings, fingerprint_of(of.source))
        fill(
            store, of, self.renders, workers=self.workers, seconds=self._left(_RENDERING),
            on_progress=lambda n: self.on_progress(LearnProgress("render", n, self.renders)),
        )  # fmt: skip
        x, images = store.read(self.renders)
        failed = store.failed(self.renders)
        if len(x) < FEWEST:
            store.remove([*failed])  # so that a renderer that was mended renders them
            raise too_few(len(x), FEWEST, sum(failed.values()), self.renders)
        if all(np.array_equal(image, images[0]) for image in images):
            store.remove(store.shards)
            raise all_equal(self.renderer.name, len(images))
        return x, images, sum(failed.values())

    def _density(self, x: Float64, images: Pixels, folder: Path) -> tuple[Network, Training]:
        """Trained network, and its training."""
        network = Network(self.size, self.renderer.periodic, self.blocks, self.seed)
        left = self._left(_DENSITY if self.emulates else 1.0)
        training = Training(
            network.to(self.device), x, images, self.passes, self.seed, left,
            augment=self.augment, clutter=self.clutter,
        )  # fmt: skip
        training.run_from(folder / "training", self._plan_of(training), self._say("train"))
        network.to("cpu").eval()
        return network, training

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
        training.run_from(folder / "emulator", self._plan_of(training), self._say("emulate"))
        if not math.isfinite(training.best):
            warn_user("the training of the emulator has diverged: learn with another seed")
            return None, None
        return emulator.to("cpu").eval(), 1 - training.best

    def _plan_of(self, training: Training) -> dict[str, Any]:
        """What a training depends on: its checkpoint is used if it is of the same."""
        return {
            "renders": len(training.x), "passes": self.passes, "seconds": self.seconds,
            "seed": self.seed, "augment": training.augment, "blocks": self.blocks,
            "clutter": None if training.clutter is None else training.clutter.digest,
        }  # fmt: skip

    def _say(self, stage: str) -> OnPass:
        return lambda done, loss: self.on_progress(LearnProgress(stage, done, self.passes, loss))

    def _left(self, share: float = 1.0) -> float | None:
        """Seconds until a share of the time has passed since the beginning; None: no limit."""
        if self.seconds is None:
            return None
        left = share * self.seconds - (clock.monotonic() - self.start)
        return max(left, min(1e-3, share * self.seconds))


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


@user_threads
def learn(
    render: Any,
    space: Space | int | None = None,
    renders: int = 100_000,
    size: int = 64,
    time: float | str | None = None,
    workers: int = 1,
    out: str | os.PathLike[str] | None = None,
    *,
    passes: int = 10,
    groups: Sequence[Sequence[int]] | None = None,
    augment: str = "photograph",
    emulator: bool | None = None,
    seed: int | None = 0,
    device: str | torch.device = "auto",
    backgrounds: str | os.PathLike[str] | Sequence[object] | None = None,
    clutter: bool | None = None,
    on_progress: Callable[[LearnProgress], None] | None = None,
) -> Model:
    """Learn once what pictures say of a renderer's parameters, for every later picture.

    Parameters
    ----------
    render
        function of a dictionary of parameters (with a `Space`) or of a point (d,) of the cube (with
        a number) that returns an image; or a task with `render(X)`.  Its attribute `version`, a
        text, says which images it makes: other versions have other renders.
    space
        `Space`, or number of parameters; None: the task's own.
    renders
        of uniformly random parameters; one in fifty, at most 2,000, judges and is not learned from.
    size
        longer side, in pixels, of what the network sees; 16 to 256.
    time
        how long everything may take, half of it rendering at most: seconds, or a text such as "10m"
        or "1h30m"; None: no limit.  With a limit the result depends on the machine.
    workers
        processes that render; with more than one `render` must be picklable.  0 and 1: in this
        process.
    out
        file of the model.  The renders are kept beside it, in `out`.renders: a call with the same
        arguments goes on where another one was interrupted, and more `renders` add to them.  None,
        the default: nothing is kept.
    passes
        over the renders, at most; training ends earlier where held-out renders say so.
    groups
        exchangeable blocks of axes, such as [[0, 1], [2, 3]], which are learned as a set; []: none
        are exchangeable; None: those of the space.
    augment
        how much renders are changed while they are learned: "photograph", for pictures of any
        source; "render", focus and noise alone, for pictures that the renderer itself makes;
        "none".  Clutter takes its place.
    emulator
        whether a learned renderer is trained, too, by which hypotheses are refined without renders,
        see `learning.emulator`; it needs exchangeable blocks.  None: where there are some.
    seed
        of the parameters, the initial weights and the order of learning; None draws one, and a call
        that was interrupted cannot go on.
    device
        where the network trains: "auto" takes CUDA if there is some.  The model computes on the
        CPU, whatever trained it.
    backgrounds
        what photographs have behind the object: a folder of pictures, a list of them, or
        "generated".  Each pass puts every render onto other parts of them; `render` says what it
        draws: it returns RGBA, or a pair of the image and its coverage (H, W) in [0, 1].
    clutter
        whether rims, shadows, things in front, light, blur, noise and JPEG change as well; None:
        where there are backgrounds.  With True alone backgrounds are generated, or left as they
        are where renders have no coverage.
    on_progress
        called after every shard of renders, after every pass, and after every held-out picture that
        judges the model.

    Raises
    ------
    OptionError, ImageError, DeviceError
        all ValueErrors: an argument is not what it must be, this machine has no such device, the
        folder of renders holds others, or another call is learning the same file.
    CheckpointError
        a ValueError: a shard of renders or a training that was interrupted is damaged.
    RenderError
        a RuntimeError: the renderer fails, or its images are all equal.
    DeviceMemoryError
        a RuntimeError: the device is full; the renders beside `out` are kept.
    DependencyError
        an ImportError: kornia is missing, which changes the renders.
    OSError
        a file cannot be read or written.
    """
    _check(renders, size, passes, workers, augment, on_progress)
    seed, seconds = torch_seed(seed), None if time is None else seconds_of("time", time)
    trains_on = resolve_device(device)
    renderer = as_renderer(render, space)
    blocks = blocks_of(renderer, groups)
    composed = clutter_of(backgrounds, clutter, seed)
    emulates = has_emulator(emulator, blocks, composed is not None)
    pool_for(renderer, (1, 1), workers)  # raises where it cannot be sent there
    _ = renderer.version  # raises for one that is no text
    shape, coverage = renderer.first_shape()
    if composed is not None and not coverage:
        composed = _without_coverage(composed, backgrounds)
    renderer = replace(renderer, shape=shape, coverage=composed is not None and coverage)
    if composed is not None and composed.changes:  # by more
        augment = "none"
    plan = _Plan(
        renderer=renderer, shape=shape, size=small_size(shape, size),
        renders=renders, passes=passes, workers=workers, seed=seed,
        blocks=blocks, seconds=seconds, start=clock.monotonic(),
        on_progress=on_progress or (lambda progress: None), augment=augment, device=trains_on,
        emulates=emulates, clutter=composed,
    )  # fmt: skip
    with folder_of(out) as folder:
        model = plan.model(folder)
    if out is not None:
        model.save(out)
    return model


def _without_coverage(clutter: Clutter, backgrounds: object) -> Clutter:
    """The same without backgrounds; raises OptionError where backgrounds were asked for."""
    if backgrounds is not None:
        raise OptionError(
            "backgrounds need renders that say what they draw: return RGBA (H, W, 4), or the image "
            "and its coverage (H, W) in [0, 1]; or give clutter=True without backgrounds"
        )
    return replace(clutter, backgrounds=(), name="clutter without backgrounds")


def _check(
    renders: object, size: object, passes: object, workers: object, augment: object,
    on_progress: object,
) -> None:  # fmt: skip
    whole_number("renders", renders, FEWEST)
    if not 16 <= whole_number("size", size, 1) <= 256:
        raise OptionError(f"size is 16 to 256 pixels, not {size}")
    whole_number("passes", passes, 1)
    whole_number("workers", workers, 0)
    check_installed(one_of(*AUGMENT)("augment", augment))
    if not (on_progress is None or callable(on_progress)):
        raise OptionError(f"on_progress must be a function of a LearnProgress, not {on_progress!r}")
