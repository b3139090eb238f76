"""What all baselines share: ask and tell, generations, the best point, saving, features of images.

A baseline is saved as what was asked and told, and loading runs it again: nothing of a library's
inner state has to be stored.
"""

from __future__ import annotations

import inspect
import sys
import warnings
from abc import abstractmethod
from array import array as numbers
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from fide_plugins import losses as losses_module
from fide_plugins.errors import CheckpointError, ImageError, LossError, OptionError
from fide_plugins.losses.base import as_losses
from fide_plugins.population import Population
from fide_plugins.runtime.schema import Schema, Sides, array, check, maybe, real, whole
from fide_plugins.runtime.threads import Lock, one_at_a_time, one_thread, timed
from fide_plugins.saving import Saved
from fide_plugins.search.cma_es import default_popsize
from fide_plugins.types import Float32, Float64, Solution
from fide_plugins.validation.images import as_batch, as_target
from fide_plugins.validation.options import positive
from fide_plugins.validation.points import as_points, new_seed, whole_number

if TYPE_CHECKING:
    from torch import Tensor


def worse_than(loss: float) -> float:
    """A finite loss above a finite one, unless that is the largest number there is."""
    return min(loss + 1.0 + abs(loss), sys.float_info.max)


class Penalty:
    """Finite losses in place of those that are not: worse than all before."""

    def __init__(self) -> None:
        self._worst: float | None = None

    def __call__(self, loss: float) -> float:
        """`loss` itself if it is finite."""
        if np.isfinite(loss):
            self._worst = loss if self._worst is None else max(loss, self._worst)
            return loss
        return worse_than(0.0 if self._worst is None else self._worst)


@contextmanager
def quietly() -> Iterator[None]:
    """Without a library's warnings, as of flat or failed functions, which here are no error."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


_INJECTED = -1


class Baseline(Saved):
    """An optimizer over [0, 1]^dim.

    It says how it draws candidates (`_sample`), what it learns from a complete generation, as it
    was drawn (`_update`), and where its search stands (`recommend`).  Candidates that are not
    pending can become `best`, and do not move the search; NaN and infinity rank last.

    dim: number of parameters.
    target: image to fit; needed only where `tell` is to compute losses from images.
    loss: name, callable, or None for "mse"; see `fide_plugins.losses`.
    popsize: candidates a generation; None: the baseline's own default.
    sigma0: initial standard deviation, for those that have one.
    seed: same seed, same run; None draws one.
    device: of a named loss and of an encoder; "auto" takes CUDA where there is some for those that
        are networks.

    Any number of threads may ask and tell the same baseline.

    Raises OptionError (a ValueError) for options out of range, ImageError for a bad target,
    DeviceError for a device that this machine does not have.
    """

    more_options: ClassVar[tuple[str, ...]] = ()
    """Arguments of its constructor that it takes by ``**options``."""
    resumable: bool = True
    """Whether what is saved can be loaded: not if it needs images again, or large features."""
    status = None
    """No baseline says how its run is going, as `FIDE.status` does."""

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        loss: str | Callable[..., object] | None = None,
        popsize: int | None = None,
        sigma0: float = 1 / 6,
        seed: int | None = None,
        device: str = "auto",
    ) -> None:
        self.dim = whole_number("dim", dim, 1)
        if popsize is not None:
            popsize = whole_number("popsize", popsize, self._smallest_popsize())
        self.popsize = self._default_popsize() if popsize is None else popsize
        self.sigma0 = positive("sigma0", sigma0)
        self.seed = new_seed(seed)
        if device != "auto":
            from fide_plugins.runtime.devices import resolve_device  # PyTorch takes a second

            resolve_device(device)
        self.device = device
        self.target = None if target is None else as_target(target)
        self._loss = losses_module.resolve(loss, self.target, device=device)
        self.evaluations = 0
        self.times = {"encode": 0.0, "train": 0.0, "search": 0.0}  # seconds
        self._lock = Lock()
        self._best: Solution | None = None
        self._population = Population()
        self._told_features: dict[int, Float32] = {}  # (f,) each, of this generation, by candidate
        # -(n + 1): n > 0 candidates were asked; i >= 0: candidate i was told; -1: an injected one
        self._events = numbers("q")
        self._losses = numbers("d")  # told
        self._injected = numbers("d")  # points told that were not pending
        self._features: list[Float32] = []  # told
        self._asked: Float64 = np.empty((0, self.dim))  # last generation

    # -- ask and tell ------------------------------------------------------------------------------

    @property
    def best(self) -> Solution | None:
        """Best point told so far; None before the first with a finite loss."""
        return None if self._best is None else self._best.copy()

    @one_at_a_time
    @one_thread
    def ask(self, n: int | None = None) -> Float64:
        """Candidates, float64 (n, dim) in [0, 1]; None: what is left of the generation.

        If all of it is pending, another `popsize` candidates are drawn.
        """
        n = None if n is None else whole_number("n", n, 1)
        with timed(self.times, "search"):
            return np.array(list(self._hand_out(n).values()))

    def ask_ready(self) -> Float64:
        """As `ask`."""
        return self.ask()

    @one_at_a_time
    @one_thread
    def tell(self, X: object, images: object = None, losses: object = None) -> None:
        """Report results: points X (n, dim), and their losses (n,) or images to compute them of.

        A point that was asked may come back in single precision.  Everything is checked before
        anything changes.  Raises PointsError, ImageError or LossError (all ValueErrors).
        """
        points = as_points(X, self.dim)
        if images is None and losses is None:
            raise LossError("tell needs images, losses, or both; got neither")
        shape, batch = None if self.target is None else self.target.shape, None
        if images is not None:
            batch = as_batch(images, shape, n=len(points))
        with timed(self.times, "encode"):
            if losses is not None:
                values = as_losses(losses, len(points))
            else:
                assert batch is not None
                values = self._loss.compute(batch)
            features = self._encode(batch)
        with timed(self.times, "search"):
            for i, (x, loss) in enumerate(zip(points, values.tolist(), strict=True)):
                image = None if batch is None else batch[i]
                self._record(x, loss, image, None if features is None else features[i])

    def recommend(self) -> Float64:
        """Point (dim,) that the search believes in; by default the best, or the center."""
        return np.full(self.dim, 0.5) if self._best is None else self._best.x.copy()

    # -- for subclasses ----------------------------------------------------------------------------

    @abstractmethod
    def _sample(self) -> Float64:
        """Draw candidates, (popsize, dim) in [0, 1]."""

    @abstractmethod
    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        """Learn from a generation: (popsize, dim), (popsize,) finite or +inf, and (popsize, f)."""

    def _encode(self, batch: Float32 | None) -> Float32 | None:
        """Features (n, f) of images (n, H, W, 3) that `_update` needs; None: it needs none."""
        return None

    def _default_popsize(self) -> int:
        return default_popsize(self.dim)

    def _smallest_popsize(self) -> int:
        return 1

    # -- bookkeeping -------------------------------------------------------------------------------

    def _hand_out(self, n: int | None) -> dict[int, Float64]:
        """The next n candidates by index; None: those that remain of a generation."""
        population = self._population
        n = n or population.remaining or self.popsize
        handed_out: dict[int, Float64] = {}
        while len(handed_out) < n:
            if not population.remaining:
                self._asked = self._sample()
                population.draw(self._asked, self._asked)
            candidate = population.hand_out()
            handed_out[candidate.index] = candidate.x
        self._events.append(-(n + 1))
        return handed_out

    def _record(
        self, x: Float64, loss: float, image: Float32 | None, features: Float32 | None
    ) -> None:
        """Enter one result; finish the generation if that completes it."""
        finite = bool(np.isfinite(loss))
        candidate = self._population.record(x, loss if finite else np.inf)
        self._events.append(_INJECTED if candidate is None else candidate.index)
        self._losses.append(loss)
        if candidate is None:
            self._injected.extend(x.tolist())
        elif features is not None:
            self._told_features[candidate.index] = features
        if features is not None and self.resumable:
            self._features.append(features)
        if finite and (self._best is None or loss < self._best.loss):
            image = None if image is None else image.copy()
            self._best = Solution(x.copy(), loss, self.evaluations, image)
        self.evaluations += 1
        if self._population.complete:
            members, losses = self._population.close_generation()
            told, self._told_features = self._told_features, {}
            seen = np.array([told[one.index] for one in members]) if told else None
            self._update(np.array([one.x for one in members]), losses, seen)

    # -- saving: see `saving.Saved` ---------------------------------------------------------------

    def settings(self) -> dict[str, Any]:
        """Keyword arguments of the constructors, which are attributes, but `loss` and `device`."""
        inits = [vars(kind)["__init__"] for kind in type(self).__mro__ if "__init__" in vars(kind)]
        named = (p for init in inits for p in inspect.signature(init).parameters.values())
        names = {p.name for p in named if p.kind is p.KEYWORD_ONLY} - {"loss", "device"}
        own = {name: getattr(self, name) for name in sorted(names)}
        return {"dim": self.dim, "target": self.target, **own}

    @property
    def loss_name(self) -> str | None:
        """Name by which the loss can be made again; None for a user's own."""
        return self._loss.spec

    @one_at_a_time
    def state_dict(self) -> dict[str, Any]:
        """The best point, the counts, and the history."""
        names, best = ("x", "loss", "evaluation", "image"), self._best
        return {
            "evaluations": self.evaluations,
            "best": None if best is None else {name: getattr(best, name) for name in names},
            "times": dict(self.times),
            "events": np.array(self._events, np.int64),
            "losses": np.array(self._losses, np.float64),
            "injected": np.array(self._injected, np.float64).reshape(-1, self.dim),
            "features": np.array(self._features, np.float32) if self._features else None,
            "asked": self._asked,
        }

    @one_at_a_time
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where `state_dict` was called; ValueError if `state` is impossible.

        Raises CheckpointError (a ValueError) if it needs images again, which a checkpoint does not
        hold, or if the replay asks for other candidates.
        """
        if not self.resumable:
            raise CheckpointError(
                f"{self.name} learns from images, which a checkpoint does not hold, so it cannot "
                "be resumed; run it again from the beginning, in another directory"
            )
        sides = {"d": self.dim}
        if self.target is not None:
            sides["H"], sides["W"], _ = self.target.shape
        check(state, _SCHEMA, self._sides() | sides)
        self._replay(state)
        if not np.array_equal(self._asked, state["asked"]):
            raise CheckpointError(
                f"{self.name} asks for other candidates when it is run again; draw random numbers "
                "from its seed, or run it again from the beginning, in another directory"
            )
        self.evaluations, self.times = state["evaluations"], dict(state["times"])
        self._best = None if state["best"] is None else Solution(**state["best"])

    def _sides(self) -> Sides:
        return {}

    def _replay(self, state: Mapping[str, Any]) -> None:
        """Ask and tell what the saved baseline was asked and told."""
        events: list[int] = state["events"].tolist()
        told, injected = sum(event >= _INJECTED for event in events), events.count(_INJECTED)
        seen = [None] * told if state["features"] is None else list(state["features"])
        if (told, told, injected) != (len(state["losses"]), len(seen), len(state["injected"])):
            raise ValueError(f"a history of {told} results, {injected} injected, lacks some")
        points, losses = iter(state["injected"]), iter(state["losses"].tolist())
        features = iter(seen)
        pending: dict[int, Float64] = {}
        for event in events:
            if event < _INJECTED:
                pending |= self._hand_out(-event - 1)
            else:
                x = next(points) if event == _INJECTED else pending.pop(event)
                self._record(x, next(losses), None, next(features))


_SCHEMA: Schema = {
    "evaluations": whole(),
    "best": maybe(
        {
            "x": array("d", low=0.0, high=1.0),
            "loss": real(),
            "evaluation": whole(),
            "image": maybe(array("H", "W", 3, low=0.0, high=1.0)),
        }
    ),
    "times": {"encode": real(), "train": real(), "search": real()},
    "events": array("e", kind="i", low=None),
    "losses": array("t", low=None),
    "injected": array("n", "d", low=0.0, high=1.0),
    "features": maybe(array("t", "f")),
    "asked": array("k", "d", low=0.0, high=1.0),
}


# -- features of images ----------------------------------------------------------------------------


class ImageBased(Baseline):
    """A baseline to which images must be told; losses beside them are optional, as always.

    target: image to fit, required: ImageError (a ValueError) without it.
    encoder: name in `fide_plugins.encoders`, whose `make` raises.
    channels: number of leading channels of its tokens that are used; None: all.  The first three of
        "dense" are the mean colors of (at most) 14 x 14 patches.
    """

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        encoder: str = "dense",
        channels: int | None = None,
        **options: Any,
    ) -> None:
        super().__init__(dim, target, **options)
        if self.target is None:
            raise ImageError(f"{self.name} learns from images and needs a target; got none")
        from fide_plugins import encoders  # PyTorch takes a second
        from fide_plugins.runtime.devices import resolve_device

        self.encoder = encoder
        where = resolve_device(self.device, for_network=encoders.uses_network(encoder))
        self._encoder = encoders.make(encoder, device=where)
        self._tokens, most = self._encoder.shape(*self.target.shape[:2])
        if channels is not None and whole_number("channels", channels, 1) > most:
            raise OptionError(f"channels must be at most {most} for {encoder}, not {channels}")
        self.channels = channels
        self.target_features: Float32 = self._encode(self.target[None])[0]
        """Features (f,) of the target."""

    @property
    def pretrained(self) -> tuple[str, str] | None:
        """Name of the encoder and digest of its pretrained weights; None if it has none."""
        digest = self._encoder.weights_digest
        return None if digest is None else (self.encoder, digest)

    @property
    def target_tokens(self) -> Tensor:
        """Tokens (T, C) of the target."""
        return self.tokens_of(self.target_features[None])[0]

    def tokens_of(self, features: Float32) -> Tensor:
        """Tokens (n, T, C) from features (n, f), f = T C."""
        import torch  # takes a second

        return torch.from_numpy(features).reshape(len(features), self._tokens, -1)

    def _encode(self, batch: Float32 | None) -> Float32:
        images = needed_images(self.name, batch)
        tokens = self._encoder.compute(images)[..., : self.channels]  # (n, T, C)
        features: Float32 = tokens.flatten(1).cpu().numpy().astype(np.float32)
        return features

    @one_at_a_time
    def state_dict(self) -> dict[str, Any]:
        """As that of any baseline, and the version of the encoder."""
        return {**super().state_dict(), "encoder": self._encoder.version}

    @one_at_a_time
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """As any baseline; CheckpointError (a ValueError) also for features of another encoder."""
        self._encoder.check_version(state["encoder"])
        super().load_state_dict({k: value for k, value in state.items() if k != "encoder"})

    def _sides(self) -> Sides:
        return {"f": len(self.target_features)}


def needed_images(name: str, batch: Float32 | None) -> Float32:
    """The images (n, H, W, 3) told to the baseline `name`; ImageError (a ValueError) for None."""
    if batch is None:
        raise ImageError(f"{name} learns from images: tell them, losses alone are no use")
    return batch
