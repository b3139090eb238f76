"""`learn`: renders of random parameters, a network trained on them, and how good it is."""

from __future__ import annotations

import os
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch

from fide_plugins.errors import OptionError, UnknownNameError
from fide_plugins.fitting.durations import seconds_of
from fide_plugins.learning.model import Model
from fide_plugins.learning.networks.head_choice import has_emulator, kind_of
from fide_plugins.learning.networks.network import HEADS
from fide_plugins.learning.plan import FEWEST, LearnProgress, Plan
from fide_plugins.learning.renders.identity import version_for
from fide_plugins.learning.renders.renderer import as_renderer, small_size
from fide_plugins.learning.renders.store import RenderStore, folder_of
from fide_plugins.learning.training.augmentation import AUGMENT, check_installed
from fide_plugins.learning.truncation import Truncated
from fide_plugins.runtime.devices import resolve_device
from fide_plugins.runtime.registry import fingerprint_of
from fide_plugins.runtime.threads import user_threads
from fide_plugins.space import Space
from fide_plugins.validation.options import not_negative
from fide_plugins.validation.points import torch_seed, whole_number

__all__ = ["learn"]

_AT_A_TIME = 8  # shards that an executor gets


@user_threads
def learn(
    render: Any,
    space: Space | int | None = None,
    renders: int = 100_000,
    size: int = 64,
    time: float | str | None = None,
    workers: int | None = None,
    out: str | os.PathLike[str] | None = None,
    *,
    passes: int = 10,
    executor: object = None,
    groups: Sequence[Sequence[int]] | None = None,
    head: str | None = None,
    augment: str = "photograph",
    emulator: bool | None = None,
    version: str | None = None,
    seed: int | None = 0,
    store_limit: float = 20.0,
    device: str | torch.device = "auto",
    after: str | os.PathLike[str] | None = None,
    picture: object = None,
    on_progress: Callable[[LearnProgress], None] | None = None,
) -> Model:
    """Learn once what pictures say of a renderer's parameters, for every later picture.

    Parameters
    ----------
    render
        function of a dictionary of parameters (with a `Space`) or of a point (d,) of the cube (with
        a number) that returns an image; or a task with `render(X)`.
    space
        `Space`, or number of parameters; None: the task's own.
    renders
        of uniformly random parameters; one in fifty, at most 2,000, judges and is not learned from.
    size
        longer side, in pixels, of what the network sees; 16 to 256.
    time
        how long everything may take, half of it rendering at most: seconds, or a text such as "10m"
        or "1h30m"; None: no limit.  With a limit the result depends on the machine.  A call that
        was interrupted in the emulator's part goes on there: more time is the density's only in the
        call after it.
    workers
        processes that render; with more than one `render` must be picklable.  0 and 1: in this
        process.  None, the default: 1, or 8 with an executor.
    out
        file of the model.  The renders are kept beside it, in `out`.renders: a call with the same
        arguments goes on where another one was interrupted, and more `renders` add to them.  None,
        the default: nothing is kept.
    passes
        over the renders, at most; training ends earlier where held-out renders say so.  With more
        of them the same call goes on from where it ended, at the rate that the longer schedule has
        there, to the last one.
    executor
        where to render instead, as for `fit`: "threads", any executor of `concurrent.futures`, or
        Dask's Client; `workers` says how many shards of 100 renders it gets at a time.
    groups
        exchangeable blocks of axes, such as [[0, 1], [2, 3]]; []: none are exchangeable; None:
        those of the space.
    head
        "autoregressive", "mixture" or "set", see `learning.networks.heads`; None: "set" where there
        are exchangeable blocks, "autoregressive" elsewhere.
    augment
        how much renders are changed while they are learned: "photograph", for pictures of any
        source; "render", focus and noise alone, for pictures that the renderer itself makes;
        "none", see `learning.training.augmentation`.
    emulator
        whether a learned renderer is trained, too, by which hypotheses are refined without renders,
        see `learning.networks.emulator`; it needs exchangeable blocks.  None: where there are some.
    version
        of the renderer, a text; other versions have other renders.  None: that which the renderer
        states as its attribute `version`, if it does.
    seed
        of the parameters, the initial weights and the order of learning; None draws one, and a call
        that was interrupted cannot go on.
    store_limit
        GiB that the renders may take, finite.
    device
        where the network trains: "auto" takes CUDA if there is some.  The model computes on the
        CPU, whatever trained it.  A training goes on wherever it is continued, but results of
        another device differ.
    after, picture
        for a second round: file of a model, with its renders beside it.  New renders are drawn
        where its posterior of the picture is, see `learning.truncation`, and learned with the old
        ones.  What comes of it is a model of that picture.
    on_progress
        called after every shard of renders, after every pass, and after every held-out picture that
        calibrates or judges the model.

    Raises
    ------
    OptionError, ImageError, DeviceError
        all ValueErrors: an argument is not what it must be, this machine has no such device, or the
        folder of renders holds others: their settings differ, or the renderer's images do, see
        `learning.renders.identity`; or another call is learning the same file.
    CheckpointError
        a ValueError: a file is damaged, or of something else: a shard of renders, a training that
        was interrupted, or the model `after`.
    RenderError
        a RuntimeError: the renderer fails, or its images are all equal.
    DeviceMemoryError
        a RuntimeError: the device is full; the renders beside `out` are kept.
    DependencyError
        an ImportError: kornia is missing, which changes the renders.
    OSError
        a file cannot be read or written.
    """
    if workers is None:
        workers = 1 if executor is None else _AT_A_TIME
    _check(renders, size, passes, workers, head, augment, on_progress)
    seed, store_limit = torch_seed(seed), not_negative("store_limit", store_limit)
    seconds = None if time is None else seconds_of("time", time)
    trains_on = resolve_device(device)
    renderer = as_renderer(render, space)
    version, (head, blocks) = version_for(renderer, version), kind_of(renderer, groups, head)
    emulates = has_emulator(emulator, blocks)
    region = _region(after, picture, seed)
    shape = renderer.first_shape()
    plan = Plan(
        renderer=replace(renderer, shape=shape), shape=shape, size=small_size(shape, size),
        renders=renders, passes=passes, workers=workers, executor=executor, seed=seed,
        version=version, head=head, blocks=blocks, seconds=seconds, start=clock.monotonic(),
        on_progress=on_progress or (lambda progress: None), augment=augment, device=trains_on,
        emulates=emulates, region=region,
    )  # fmt: skip
    plan.check(store_limit)
    with folder_of(out) as folder:
        draw = None if region is None else region.parameters
        store = RenderStore(folder, plan.settings, fingerprint_of(renderer.source), draw)
        model = plan.model(store)
    if out is not None:
        model.save(out)
    return model


def _region(after: str | os.PathLike[str] | None, picture: object, seed: int) -> Truncated | None:
    """Where a second round renders; None for a first one."""
    if (after is None) != (picture is None):
        raise OptionError("a second round needs both: after=MODEL and picture=PICTURE")
    return None if after is None else Truncated.read(after, picture, seed)


def _check(
    renders: object, size: object, passes: object, workers: object, head: object, augment: object,
    on_progress: object,
) -> None:  # fmt: skip
    whole_number("renders", renders, FEWEST)
    if not 16 <= whole_number("size", size, 1) <= 256:
        raise OptionError(f"size is 16 to 256 pixels, not {size}")
    whole_number("passes", passes, 1)
    whole_number("workers", workers, 0)
    if head is not None and head not in HEADS:
        raise UnknownNameError.of("head", head, HEADS)
    if augment not in AUGMENT:
        raise UnknownNameError.of("augment", augment, AUGMENT)
    check_installed(str(augment))
    if not (on_progress is None or callable(on_progress)):
        raise OptionError(f"on_progress must be a function of a LearnProgress, not {on_progress!r}")
