"""A model of a renderer: from a picture to several hypotheses of its parameters."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from fide_plugins.denoiser.network import full_precision
from fide_plugins.errors import CheckpointError, ImageError, ModelNotFoundError, OptionError
from fide_plugins.learning.emulator import Emulator, inverted
from fide_plugins.learning.judging import LARGEST_SCALE, Familiarity, Report
from fide_plugins.learning.networks import Network, as_input
from fide_plugins.learning.renders import pixels_of, same_aspect
from fide_plugins.runtime import checkpoint
from fide_plugins.runtime.schema import (
    IMPOSSIBLE,
    Schema,
    anything,
    array,
    check,
    each,
    flag,
    maybe,
    numbers,
    real,
    row,
    table,
    text,
    whole,
)
from fide_plugins.runtime.threads import one_thread
from fide_plugins.space import Choice, Space
from fide_plugins.space.kinds import Kind
from fide_plugins.types import Float64
from fide_plugins.validation.images import as_target
from fide_plugins.validation.points import as_points, torch_seed, whole_number

_KIND = "learned model"
_SCHEMA: Schema = {
    "dim": whole(1, 2**20),
    "space": maybe(table(anything)),
    "shape": row(whole(1, 2**20), whole(1, 2**20)),
    "size": row(whole(1, 4096), whole(1, 4096)),
    "renderer": text,
    "version": maybe(text),
    "fingerprint": maybe(text),
    "periodic": each(flag),
    "blocks": each(each(whole())),
    "weights": table(numbers),
    "emulator": maybe(table(numbers)),
    "scale": real(1.0, LARGEST_SCALE),
    "familiarity": {"mean": array("F"), "precision": array("F", "F"), "threshold": real(0.0)},
    "report": table(anything),
}


@contextmanager
def _full_precision() -> Iterator[None]:
    """Float32, whatever autocast the caller's thread is in; begun anew by every call."""
    with full_precision(torch.device("cpu")):
        yield


@dataclass(frozen=True, repr=False)
class Model:
    """What `learn` returns.  An autocast of the caller changes no result.

    network: its density calibrated.
    space: names of the parameters; None: they have none.
    shape: height and width of the renders that were given.
    renderer, version: name of the renderer, and the version that the user stated.
    fingerprint: of the renderer's source or command line; None where that is not known.
    familiarity: of features.
    report: how good it is.
    emulator: learned renderer; None: there is none.
    """

    network: Network
    space: Space | None
    shape: tuple[int, int]
    renderer: str
    version: str | None
    familiarity: Familiarity
    report: Report
    fingerprint: str | None = None
    emulator: Emulator | None = None

    def __repr__(self) -> str:
        height, width = self.size
        return (
            f"Model(of {self.renderer!r}: {self.dim} parameters, images of {width} x {height} "
            f"pixels, {self.report.renders:,} renders)"
        )

    @property
    def dim(self) -> int:
        """Number of axes of the cube."""
        return self.network.dim

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the images that the network sees."""
        return self.network.size

    @property
    def blocks(self) -> tuple[tuple[int, ...], ...]:
        """Exchangeable blocks of axes; empty: there are none."""
        return self.network.blocks

    @_full_precision()
    def sample(self, picture: object, n: int = 64, seed: int = 0) -> Float64:
        """Hypotheses (n, dim) in [0, 1] of the parameters of a picture, drawn from the posterior.

        picture: anything that `FIDE` takes as a target, of the aspect of the renders; other sizes
        are resized.  Same seed, same hypotheses.  Raises ImageError or OptionError.
        """
        n, generator = whole_number("n", n, 1), torch.Generator().manual_seed(torch_seed(seed))
        return self.network.sample(self._input(picture), n, generator).numpy().astype(np.float64)

    @torch.no_grad()
    @_full_precision()
    def log_prob(self, picture: object, X: object) -> Float64:
        """Logarithm of the posterior's density (n,), given a picture, at points X (n, dim).

        In nats; the uniform prior has 0.  A lower bound where blocks are exchangeable.
        """
        points = torch.from_numpy(as_points(X, self.dim).astype(np.float32))
        return self.network.log_prob(self._input(picture), points).numpy().astype(np.float64)

    @property
    def emulates(self) -> bool:
        """Whether it has an emulator that explains nine tenths of the variance of renders."""
        return self.emulator is not None and self.report.emulates

    @torch.inference_mode(False)
    @one_thread
    @_full_precision()
    def refined(self, picture: object, X: object, seed: int = 0) -> Float64:
        """Hypotheses (at most 8, dim) of a picture, found by descents through the emulator.

        picture: as for `sample`.  X: (n, dim) in [0, 1], n >= 1, where descents begin; the best 32
        of them are taken.  The result has the best one first.  Same seed, same hypotheses.  It
        takes seconds, and no renders.

        Raises OptionError without an emulator, and what `sample` raises.
        """
        if self.emulator is None:
            raise OptionError(
                f"the model of {self.renderer!r} has no emulator: learn it with emulator=True, "
                "which needs exchangeable blocks"
            )
        points = torch.from_numpy(as_points(X, self.dim).astype(np.float32))
        if not len(points):
            raise OptionError("X has no points: give at least one, where descents begin")
        generator = torch.Generator().manual_seed(torch_seed(seed))
        found = inverted(self.emulator, self._input(picture), points, generator)
        return found.numpy().astype(np.float64)

    def knows(self, picture: object) -> bool:
        """Whether the picture is like those that were learned, see `judging`."""
        return self.unfamiliarity(picture) <= 1

    def unfamiliarity(self, picture: object) -> float:
        """Distance of the picture from renders, in units of what is still familiar."""
        with _full_precision():
            features = self.network.vectors(self._input(picture)).numpy().astype(np.float64)
        distance = self.familiarity.distances(features)[0]
        return float(distance / max(self.familiarity.threshold, 1e-300))

    def _input(self, picture: object) -> Tensor:
        """Return the picture as the network takes it; ImageError for another aspect."""
        image = as_target(picture)
        height, width, _ = image.shape
        if not same_aspect((height, width), self.shape):
            raise ImageError(
                f"the model has learned images of {self.shape[1]} x {self.shape[0]} pixels "
                f"(width x height), and this picture is {width} x {height}: crop it to that aspect"
            )
        return as_input(pixels_of(image, self.size)[None])

    def check_space(self, space: Space | int) -> None:
        """Raise OptionError, naming the difference, unless the model has learned this space.

        A number of parameters fits a model of so many, named or not; units may differ.
        """
        dim = space.dim if isinstance(space, Space) else space
        if dim != self.dim:
            raise OptionError(
                f"the model of {self.renderer!r} has {self.dim} parameters, and the optimizer "
                f"{dim}: learn a model of this space"
            )
        if not isinstance(space, Space) or self.space is None:
            return
        old, new = _without_units(self.space), _without_units(space)
        if list(old.items()) != list(new.items()):
            why = "the parameters come in another order"
            for name in [*new, *old]:
                if old.get(name) != new.get(name):
                    there, here = old.get(name, "missing"), new.get(name, "missing")
                    why = f"{name!r} is {there} in the model and {here} here"
            raise OptionError(f"the model of {self.renderer!r} is of another space: {why}")

    # -- files -------------------------------------------------------------------------------------

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model into the file `path`, without pickle; raises OSError if that fails."""
        same = {name: getattr(self, name) for name in ("dim", "renderer", "version", "fingerprint")}
        state = {
            "space": None if self.space is None else self.space.to_dict(),
            "shape": list(self.shape), "size": list(self.size),
            "periodic": list(self.network.periodic), "blocks": [list(one) for one in self.blocks],
            "weights": dict(self.network.state_dict()), "scale": self.network.scale,
            "emulator": None if self.emulator is None else dict(self.emulator.state_dict()),
            "familiarity": asdict(self.familiarity), "report": asdict(self.report),
        }  # fmt: skip
        checkpoint.write(path, _KIND, same | state)

    @classmethod
    @torch.inference_mode(False)  # weights that are made in it have no gradients anywhere
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Model of the file `path` that `save` wrote.

        Raises ModelNotFoundError (a FileNotFoundError), which says what makes a model, another
        OSError, or CheckpointError (a ValueError) if the file is damaged or no model.
        """
        if Path(path).is_dir():
            raise IsADirectoryError(f"{os.fspath(path)!r} is a folder; name the model's file")
        try:
            state = checkpoint.read(path, _KIND)
        except FileNotFoundError as error:
            why = f"no model at {os.fspath(path)}: `fide learn` or `learn(..., out=...)` makes one"
            raise ModelNotFoundError(why) from error
        try:
            return cls._of(state)
        except IMPOSSIBLE as error:
            why = f"{os.fspath(path)}: a model with impossible contents ({error!r})"
            remedy = "learn again, or take an earlier copy, or the version of FIDE that wrote it"
            raise CheckpointError(f"{why}; {remedy}") from error

    @classmethod
    def _of(cls, state: Mapping[str, Any]) -> Self:
        check(state, _SCHEMA, {}, "model")
        check(state["report"]["emulated"], maybe(real()), {}, "model['report']['emulated']")
        (height, width), (h, w) = state["shape"], state["size"]
        if len(state["periodic"]) != state["dim"]:
            raise ValueError("it has another number of axes")
        network = Network((h, w), state["periodic"], state["blocks"])
        network.load(state["weights"])
        network.scale = float(state["scale"])
        network.eval()
        emulator = None
        if state["emulator"] is not None:
            emulator = Emulator((h, w), state["periodic"], state["blocks"])
            emulator.load(state["emulator"])
        report: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in state["report"].items()
        }
        report["curve"] = tuple(tuple(row) for row in report["curve"])
        space = None if state["space"] is None else Space.from_dict(state["space"])
        model = cls(
            network=network, space=space, shape=(height, width), renderer=state["renderer"],
            version=state["version"], familiarity=Familiarity(**state["familiarity"]),
            report=Report(**report), fingerprint=state["fingerprint"], emulator=emulator,
        )  # fmt: skip
        str(model.report)  # raises for one that says nothing
        gray = torch.full((1, 3, h, w), 0.5, dtype=torch.float32)  # whatever the default is
        of_gray = network.vectors(gray), network.sample(gray, 1, torch.Generator())
        if not all(bool(values.isfinite().all()) for values in of_gray):
            raise ValueError("its weights are finite, but not what they make of a gray picture")
        return model


def _without_units(space: Space) -> dict[str, Kind]:
    """Parameters by flat name, without what is for people alone."""
    found = space.parameters
    return {n: k if isinstance(k, Choice) else replace(k, unit=None) for n, k in found.items()}
