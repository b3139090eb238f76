"""Renders of random parameters: what makes them, and where they are kept."""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from inspect import signature
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from fide_plugins.errors import CheckpointError, ImageError, OptionError, RenderError
from fide_plugins.fitting.rendering import Failed, attempt
from fide_plugins.runtime import checkpoint
from fide_plugins.runtime.files import (
    atomic_writer,
    check_writable,
    locked,
    open_regular,
    remove_leftovers,
)
from fide_plugins.runtime.messages import warn_user
from fide_plugins.runtime.opencv import cv2
from fide_plugins.runtime.registry import changed, own_name, version_of
from fide_plugins.space import Space
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.images import alpha_of, as_target
from fide_plugins.validation.points import number_of_parameters

Pixels = npt.NDArray[np.uint8]
Small: TypeAlias = Pixels | Failed
"""An image (H, W, 3) as a store has it, or why there is none."""

_OTHERS = 4  # points that are tried where the renderer fails in the middle of the cube
_ASPECT = 0.02  # relative difference of height / width that is rounding


@dataclass(frozen=True)
class BatchRenderer:
    """What renders several points: a function of one, or an object with `render(X)`.

    It gets arrays of its own, since it may change them.
    shape: height and width of its images; others of that aspect are taken, too.  None: of any.
    coverage: whether images are kept with what they cover, see `covered`.
    """

    source: Any
    space: Space | None
    dim: int
    name: str
    shape: tuple[int, int] | None = None
    coverage: bool = False

    @property
    def periodic(self) -> tuple[bool, ...]:
        """(d,), axes that wrap around."""
        return (False,) * self.dim if self.space is None else tuple(self.space.periodic.tolist())

    @property
    def version(self) -> str | None:
        """Version that it states; OptionError for one that is no text."""
        return version_of(self.source)

    def small(self, X: Float64, seeds: Sequence[int], size: tuple[int, int]) -> list[Small]:
        """Images of the points X (n, d), resized to (height, width); of one that failed a `Failed`.

        seeds: (n,), of the noise of each, for a source whose `render` takes them.  Unless a batch
        can be rendered as a whole, each image is made small before the next one: full ones take
        much memory, and a renderer may draw all of them into one array.
        """
        if hasattr(self.source, "render") and getattr(self.source, "piece", None) != 1:
            batch = attempt(
                lambda: [self._small(image, size) for image in self._batch(X, seeds)], _briefly
            )
            if not isinstance(batch, Failed):
                return batch
        return [self._small(self._image(*one), size) for one in zip(X, seeds, strict=True)]

    def _image(self, x: Float64, seed: int = 0) -> Any:
        """What is rendered at x (d,), or a `Failed`."""
        if hasattr(self.source, "render"):
            return attempt(lambda: self._batch(x[None], [seed])[0], _briefly)
        space = self.space
        return attempt(
            lambda: self.source(x.copy() if space is None else space.decode(x)), _briefly
        )

    def _batch(self, X: Float64, seeds: Sequence[int]) -> Any:
        if "seed" in signature(self.source.render).parameters:
            return self.source.render(X.copy(), seed=list(seeds))
        return self.source.render(X.copy())

    def first_shape(self) -> tuple[tuple[int, int], bool]:
        """Height and width of an image, and whether it has a coverage.

        It is that of the middle of the cube, or where that fails of one of a few other points.
        Raises RenderError if all of them fail, ImageError if there is no image.
        """
        others = np.random.default_rng(0).random((_OTHERS, self.dim))
        errors: list[Exception] = []
        for x in (np.full(self.dim, 0.5), *others):
            image = self._image(x)
            if isinstance(image, Failed):
                where = f"in the middle of the space, and at {_OTHERS} other points"
                errors.append(RenderError(f"{self.name} failed {where}: {image.reason}"))
                continue
            try:
                found = covered(image, self._what)
                height, width, _ = (self._canonical(image) if found is None else found).shape
                return (height, width), found is not None
            except ImageError as error:
                errors.append(error)
        raise errors[0]

    @property
    def _what(self) -> str:
        return f"the image of {self.name}"

    def _canonical(self, image: Any) -> Float32:
        """Image (H, W, 3), or (H, W, 4) as `covered` has it, where that is kept."""
        if not self.coverage:
            return as_target(image[0] if _is_pair(image) else image, what=self._what)
        found = covered(image, self._what)
        if found is None:
            raise ImageError(f"{self._what} has no coverage, and the first one had: give all one")
        return found

    def _small(self, image: Any, size: tuple[int, int]) -> Small:
        if isinstance(image, Failed):
            return image
        try:
            whole = self._canonical(image)
        except ImageError as error:
            return Failed(str(error))
        height, width = whole.shape[:2]
        if self.shape is not None and not same_aspect((height, width), self.shape):
            return Failed(
                f"{self._what} has {width} x {height} pixels (width x height), and the first one "
                f"had {self.shape[1]} x {self.shape[0]}"
            )
        return pixels_of(whole, size)


def _is_pair(image: Any) -> bool:
    """Whether it is an image with its coverage."""
    return isinstance(image, tuple) and len(image) == 2


def covered(image: Any, what: str) -> Float32 | None:
    """Colors times the coverage, and the coverage (H, W, 4) of a render; None if it has none.

    image: RGBA (H, W, 4), or a pair of an image and its coverage (H, W) in [0, 1].

    Raises ImageError, also for a coverage of another size.
    """
    if _is_pair(image):
        colors = as_target(image[0], what=what)
        coverage = as_target(image[1], what=f"the coverage of {what}")[..., :1]
        if coverage.shape[:2] != colors.shape[:2]:
            (h, w), (height, width) = coverage.shape[:2], colors.shape[:2]
            raise ImageError(
                f"the coverage of {what} has {w} x {h} pixels (width x height), and the image "
                f"{width} x {height}: give both one size, or return RGBA"
            )
        return np.concatenate([colors * coverage, coverage], axis=2)
    shape: tuple[int, ...] = getattr(image, "shape", ())
    if len(shape) != 3 or 4 not in (shape[-1], shape[0]):
        return None
    try:
        coverage = alpha_of(image, what)[..., None]
    except ImageError:  # of three channels, and four pixels high
        return None
    return np.concatenate([as_target(image, what=what, behind=0.0), coverage], axis=2)


def _briefly(error: BaseException) -> Failed:
    """Failed render of an exception, without its traceback: there may be thousands."""
    return Failed(f"{type(error).__name__}: {error}")


def as_renderer(render: Any, space: Space | int | None) -> BatchRenderer:
    """Return the renderer for what a user gave to `learn`; raises OptionError."""
    batch = hasattr(render, "render")
    if not batch and not callable(render):
        raise OptionError(f"render must be a function or a task, not {type(render).__name__}")
    if space is None and not batch:
        raise OptionError("a function needs its space: learn(render, space), or learn(render, dim)")
    if space is None:
        space = getattr(render, "space", None) or render.dim
    named = space if isinstance(space, Space) else None
    dim = named.dim if named is not None else number_of_parameters("space", space)
    if batch and getattr(render, "dim", dim) != dim:
        raise OptionError(f"the task has {render.dim} parameters, and the space {dim}")
    return BatchRenderer(render, named, dim, own_name(render))


# -- sizes -----------------------------------------------------------------------------------------


def small_size(shape: tuple[int, ...], size: int) -> tuple[int, int]:
    """Height and width of images of this shape (H, W, ...) whose longer side becomes `size`."""
    scale = size / max(shape[:2])
    return max(1, round(shape[0] * scale)), max(1, round(shape[1] * scale))


def same_aspect(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two images (height, width) have one aspect, but for rounding."""
    change = (one[0] / one[1]) / (other[0] / other[1])
    return abs(math.log(change)) <= _ASPECT + 1 / min(*one, *other)


def resized(image: Float32, size: tuple[int, int]) -> Float32:
    """Image (H, W, 3) resized to (height, width), by means of areas where it shrinks."""
    if image.shape[:2] == size:
        return image
    shrinks = image.shape[0] >= size[0] and image.shape[1] >= size[1]
    how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size[::-1], interpolation=how), np.float32)


def pixels_of(image: Float32, size: tuple[int, int]) -> Pixels:
    """Image (H, W, 3) resized to (height, width), as a store has it."""
    return np.rint(np.clip(resized(image, size), 0.0, 1.0) * 255).astype(np.uint8)


# -- store -----------------------------------------------------------------------------------------


SHARD = 100
"""Renders of a shard: what a kill loses, at most, for each worker."""

_KIND = "renders"
_LOCK = ".learn.lock"


class RenderStore:
    """A folder of shards of renders of random parameters, each written atomically.

    Shard i holds the renders of the parameters that a generator with the seed (seed, i) draws, so
    it is the same whatever the number of workers, and whatever was interrupted:

        settings          what the renders are of, written before the first shard
        000000.npz, ...   x (n, d) float64 and images (n, H, W, 3) uint8; failed renders are left
                          out; a fourth channel has the coverage, and colors are multiplied by it

    settings: plain values that define the renders; fingerprint: of the renderer, of which another
        one is a warning.

    Raises OptionError if the folder holds other renders, naming the difference; OSError if it
    cannot be written, or has lost its settings.
    """

    def __init__(
        self, folder: Path, settings: Mapping[str, Any], fingerprint: str | None = None
    ) -> None:
        self.folder, self.settings = folder, dict(settings)
        self._written = {**settings, "fingerprint": fingerprint}
        folder.mkdir(parents=True, exist_ok=True)
        self._bound = bool(self.shards)  # without any, settings bind nobody
        if self._bound:
            there = checkpoint.read(folder / "settings", _KIND)
            before = there.pop("fingerprint", None)
            differences = [
                f"its {name} is {there.get(name)!r}, not {self.settings.get(name)!r}"
                for name in sorted({*there, *self.settings})
                if there.get(name) != self.settings.get(name)
            ]
            if differences:
                raise OptionError(
                    f"{folder} holds other renders: {'; '.join(differences)}; name another file, "
                    "or delete the folder"
                )
            if changed(before, fingerprint) and settings.get("version") is None:
                warn_user(
                    f"the renderer was changed since the renders in {folder} were made; delete "
                    "that folder if its images are others now"
                )
            if before != fingerprint:
                self._bind()

    def _bind(self) -> None:
        checkpoint.write(self.folder / "settings", _KIND, self._written)
        self._bound = True

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of an image: 4 channels where it has a coverage, see `covered`."""
        height, width = self.settings["size"]
        return height, width, 4 if self.settings.get("coverage") else 3

    @property
    def shards(self) -> list[int]:
        """Numbers of the shards that are there."""
        stems = [path.stem for path in self.folder.glob("[0-9]" * 6 + "*.npz")]
        return sorted(int(stem) for stem in stems if stem.isdecimal())  # others are foreign

    def parameters(self, shard: int) -> Float64:
        """Parameters (SHARD, d) of a shard, the same each time."""
        rng = np.random.default_rng((self.settings["seed"], shard))
        return rng.random((SHARD, self.settings["dim"]))

    def noise_seeds(self, shard: int) -> list[int]:
        """Seeds (SHARD,) of the noise of its renders: others than those of any run's renders."""
        first = 2**80 + self.settings["seed"] * 2**40 + shard * SHARD
        return [first + i for i in range(SHARD)]

    def missing(self, renders: int) -> list[int]:
        """Numbers of the shards that are not there yet, for so many renders."""
        return sorted({*range(-(-renders // SHARD))} - {*self.shards})

    def write(self, shard: int, images: Sequence[Small]) -> None:
        """Write a shard without the renders that have failed."""
        good = [i for i, image in enumerate(images) if not isinstance(image, Failed)]
        kept = np.array([images[i] for i in good], np.uint8).reshape(len(good), *self.shape)
        if not self._bound:
            self._bind()
        with atomic_writer(self._path(shard)) as file:
            np.savez(file, x=self.parameters(shard)[good], images=kept)

    def remove(self, shards: Sequence[int]) -> None:
        """Remove shards, so that they are missing."""
        for shard in shards:
            self._path(shard).unlink(missing_ok=True)

    def failed(self, renders: int) -> dict[int, int]:
        """How many renders have failed of each shard where some have; raises as `read`."""
        found = {i: SHARD - len(self._read(i)[0]) for i in self._present(renders)}
        return {i: number for i, number in found.items() if number}

    def read(self, renders: int) -> tuple[Float64, Pixels]:
        """Parameters (n, d) and images (n, H, W, 3) that are there; CheckpointError for damage."""
        shards = self._present(renders)
        x = np.empty((SHARD * len(shards), self.settings["dim"]))
        images = np.empty((len(x), *self.shape), np.uint8)
        n = 0
        for shard in shards:  # no second copy of all: they may take half the memory
            some, pixels = self._read(shard)
            x[n : n + len(some)], images[n : n + len(some)] = some, pixels
            n += len(some)
        return x[: min(n, renders)], images[: min(n, renders)]

    def _present(self, renders: int) -> list[int]:
        return [i for i in self.shards if i * SHARD < renders]

    def _read(self, shard: int) -> tuple[Float64, Pixels]:
        path = self._path(shard)
        try:
            with open_regular(path) as raw, np.load(raw, allow_pickle=False) as file:
                x, images = file["x"], file["images"]
        except Exception as error:  # decoders of untrusted bytes raise nearly anything
            why = f"{path}: damaged ({error}); delete it to render again"
            raise CheckpointError(why) from error
        n, dim = len(x), self.settings["dim"]
        if x.shape != (n, dim) or images.shape != (n, *self.shape):
            raise CheckpointError(f"{path}: of another space or size; delete it to render again")
        return x, images

    def _path(self, shard: int) -> Path:
        return self.folder / f"{shard:06d}.npz"


@contextmanager
def folder_of(out: str | os.PathLike[str] | None) -> Iterator[Path]:
    """Folder of the renders that a model is learned from, locked: beside its file; None: temporary.

    Raises OSError where the file cannot be written, OptionError where another call has the folder.
    """
    if out is None:
        with tempfile.TemporaryDirectory(prefix="fide-renders-") as made:
            yield Path(made)
        return
    if Path(out).is_dir():
        raise IsADirectoryError(f"{os.fspath(out)} is a folder; name a file for the model")
    check_writable(Path(out).absolute().parent)
    folder = Path(f"{os.fspath(out)}.renders")
    folder.mkdir(exist_ok=True)
    with locked(folder / _LOCK) as mine:
        if not mine:
            raise OptionError(
                f"the model {os.fspath(out)} is being learned, in another process or in this one; "
                "wait until that ends or stop it, and go on then, or name another file"
            )
        remove_leftovers(folder)  # of nobody who still writes
        yield folder
