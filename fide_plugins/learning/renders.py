"""Renders of random parameters: what makes them, where they are kept, whether they can be used.

A store is a folder of shards, each written atomically.  Shard i holds the renders of the parameters
that a generator with the seed (seed, i) draws, so it is the same whatever the number of workers,
and whatever was interrupted.

    settings          what the renders are of, a checked file (`runtime.checkpoint`), written
                      before the first shard
    000000.npz, ...   x (n, d) float64 and images (n, H, W, 3) uint8; failed renders are left out;
                      a fourth channel has the coverage, and colors are multiplied by it

A model that learns images of two renderers learns neither.  So before renders are added to a
folder, some of those that are there are rendered again (`check_images`).  That also notices what no
fingerprint of the source knows: what it imports, the files it reads, the version of a program.
"""

from __future__ import annotations

import math
import os
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
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
from fide_plugins.runtime.opencv import cv2
from fide_plugins.runtime.registry import (
    changed,
    check_version,
    fingerprint_of,
    own_name,
    version_of,
)
from fide_plugins.space import Space
from fide_plugins.types import Float32, Float64, Mask
from fide_plugins.validation.images import alpha_of, as_target
from fide_plugins.validation.points import number_of_parameters

Pixels = npt.NDArray[np.uint8]
Small: TypeAlias = Pixels | Failed
"""An image (H, W, 3) as a store has it, or why there is none."""

_OTHERS = 4  # points that are tried where the renderer fails in the middle of the cube
_ASPECT = 0.02  # relative difference of height / width that is rounding


@dataclass(frozen=True)
class BatchRenderer:
    """What renders several points.

    source: a function of one point, or an object with `render(X)` for a batch.  It gets arrays of
        its own, since it may change them.
    space: names of the parameters; None: the function gets a point of the cube.
    dim: d.
    name: of the function, or of the task.
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
        if self.space is None:
            return (False,) * self.dim
        return tuple(bool(each) for each in self.space.periodic)

    def small(self, X: Float64, seeds: Sequence[int], size: tuple[int, int]) -> list[Small]:
        """Images of the points X (n, d), resized to (height, width); of one that failed a `Failed`.

        seeds: (n,), of the noise of each, for a source whose `render` takes them.
        A batch that fails as a whole is rendered point by point.

        Each image of a function, or of a task whose `piece` is 1, is made small before the next one
        is rendered: full ones take much memory, and a renderer may draw all of them into one array.
        """
        if not hasattr(self.source, "render"):
            return [self._small(attempt(partial(self._one, x), _briefly), size) for x in X]
        if getattr(self.source, "piece", None) != 1:
            batch = attempt(
                lambda: [self._small(image, size) for image in self._batch(X, seeds)], _briefly
            )
            if not isinstance(batch, Failed):
                return batch
        return [
            self._small(attempt(partial(self._single, x, seed), _briefly), size)
            for x, seed in zip(X, seeds, strict=True)
        ]

    def _single(self, x: Float64, seed: int) -> Any:
        return self._batch(x[None], [seed])[0]

    def _batch(self, X: Float64, seeds: Sequence[int]) -> Any:
        if "seed" in signature(self.source.render).parameters:
            return self.source.render(X.copy(), seed=list(seeds))
        return self.source.render(X.copy())

    def _one(self, x: Float64) -> Any:
        return self.source(x.copy() if self.space is None else self.space.decode(x))

    def first_shape(self) -> tuple[tuple[int, int], bool]:
        """Height and width of the image of the middle of the cube, and whether it has a coverage.

        Where that one fails, of the image of one of a few other points.  Raises RenderError if the
        renderer fails for all of them, ImageError if it gives no image.
        """
        try:
            return self._shape_at(np.full(self.dim, 0.5))
        except (RenderError, ImageError):
            for x in np.random.default_rng(0).random((_OTHERS, self.dim)):
                with suppress(RenderError, ImageError):
                    return self._shape_at(x)
            raise

    def _shape_at(self, x: Float64) -> tuple[tuple[int, int], bool]:
        """As `first_shape`, of the image of a point; errors are those of the first, the middle."""
        try:
            batch = hasattr(self.source, "render")
            image = self.source.render(x[None])[0] if batch else self._one(x)
        except (Exception, SystemExit) as error:  # scripts end by sys.exit
            why = f"{type(error).__name__}: {error}"
            raise RenderError(
                f"{self.name} failed in the middle of the space, and at {_OTHERS} other points: "
                f"{why}"
            ) from error
        found = covered(image, self._what)
        height, width, _ = (self._canonical(image) if found is None else found).shape
        return (height, width), found is not None

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
                f"the image of {self.name} has {width} x {height} pixels (width x height), and "
                f"the first one had {self.shape[1]} x {self.shape[0]}"
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
    colors = as_target(image, what=what, behind=0.0)
    return np.concatenate([colors, coverage], axis=2)


def _briefly(error: BaseException) -> Failed:
    """Failed render of an exception, without its traceback: there may be thousands."""
    return Failed(f"{type(error).__name__}: {error}")


def as_renderer(render: Any, space: Space | int | None) -> BatchRenderer:
    """Return the renderer for what a user gave; raises OptionError.

    render: function of a dictionary (with a `Space`) or of a point (d,), or a task.
    space: `Space`, or number of parameters; None: the task's own.
    """
    own = getattr(render, "space", None) or getattr(render, "dim", None)
    batch = hasattr(render, "render")
    if not batch and not callable(render):
        raise OptionError(f"render must be a function or a task, not {type(render).__name__}")
    if space is None and not batch:
        raise OptionError("a function needs its space: learn(render, space), or learn(render, dim)")
    space = own if space is None else space
    named = space if isinstance(space, Space) else None
    dim = named.dim if named is not None else number_of_parameters("space", space)
    if batch and getattr(render, "dim", dim) != dim:
        raise OptionError(f"the task has {render.dim} parameters, and the space {dim}")
    return BatchRenderer(render, named, dim, own_name(render))


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
_NUMBER = re.compile("[0-9]{6,}")


class RenderStore:
    """Renders of random parameters.

    folder: made if it is missing.
    settings: plain values that define the renders: "dim", "size", "seed" and more.
    fingerprint: of the renderer, for a new folder, see `runtime.registry`; None where nothing
        is known.  That of an earlier folder stays until it is replaced, see `accept`.

    Raises OptionError if the folder holds other renders, naming the difference; OSError if it
    cannot be written.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        settings: Mapping[str, Any],
        fingerprint: str | None = None,
    ) -> None:
        self.folder, self.settings = Path(folder), dict(settings)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.fingerprint, self.version = fingerprint, self.settings.get("version")
        self._agreed = False  # whether the folder's settings are known to be these
        if self._all():  # without any, settings bind nobody: all renders failed, or none was made
            self._agree()

    def _agree(self) -> None:
        """Take over what the folder says; or OptionError, if it holds other renders."""
        if not self._file.exists():  # it was lost
            self.accept(self.fingerprint)
            return
        there = checkpoint.read(self._file, _KIND)
        self.fingerprint, self.version = there.pop("fingerprint", None), there.get("version")
        if self.version is None:  # one that is stated now may be that of the images: `check_images`
            there["version"] = self.settings.get("version")
        _check_same(self.folder, there, self.settings)
        self._agreed = True

    def accept(self, fingerprint: str | None) -> None:
        """Record fingerprint and version of the renderer whose images these are; or OSError."""
        checkpoint.write(self._file, _KIND, {**self.settings, "fingerprint": fingerprint})
        self.fingerprint, self.version = fingerprint, self.settings.get("version")
        self._agreed = True

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the images."""
        height, width = self.settings["size"]
        return height, width

    @property
    def channels(self) -> int:
        """Of the images: 4 where they have a coverage, see `covered`."""
        return 4 if self.settings.get("coverage") else 3

    def parameters(self, shard: int) -> Float64:
        """Parameters (SHARD, d) of a shard, the same each time."""
        rng = np.random.default_rng((self.settings["seed"], shard))
        return rng.random((SHARD, self.settings["dim"]))

    def missing(self, renders: int) -> list[int]:
        """Numbers of the shards that are not there yet, for so many renders."""
        return [i for i in range(-(-renders // SHARD)) if not self._path(i).exists()]

    def noise_seeds(self, shard: int) -> list[int]:
        """Seeds (SHARD,) of the noise of its renders: others than those of any run's renders."""
        first = 2**80 + self.settings["seed"] * 2**40 + shard * SHARD
        return [first + i for i in range(SHARD)]

    def write(self, shard: int, images: Sequence[Small]) -> int:
        """Write a shard; returns how many of its renders have failed, which are left out.

        Raises OptionError if another call has put other renders into the folder meanwhile.
        """
        kept = [image for image in images if not isinstance(image, Failed)]
        good = np.array([not isinstance(image, Failed) for image in images], bool)
        pixels = np.array(kept, np.uint8).reshape(len(kept), *self.size, self.channels)
        if not self._agreed:
            if self._all():
                self._agree()
            else:
                self.accept(self.fingerprint)
        with atomic_writer(self._path(shard)) as file:
            np.savez(file, x=self.parameters(shard)[good], images=pixels)
        return int((~good).sum())

    def examples(self, most: int) -> tuple[Float64, list[int], Pixels]:
        """Points (n, d), seeds of the noise (n,) and images (n, H, W, 3) of some renders.

        They come from shards that are far apart; fewer than `most` where shards have lost renders.
        Raises CheckpointError for a shard that is damaged.
        """
        there = self._all()
        picked = [there[k * len(there) // most] for k in range(most)] if there else []
        parts = [self._some(shard, picked.count(shard)) for shard in dict.fromkeys(picked)]
        empty = np.empty((0, *self.size, self.channels), np.uint8)
        return (
            np.concatenate([np.empty((0, self.settings["dim"])), *(x for x, _, _ in parts)]),
            [seed for _, seeds, _ in parts for seed in seeds],
            np.concatenate([empty, *(images for _, _, images in parts)]),
        )

    def _some(self, shard: int, most: int) -> tuple[Float64, list[int], Pixels]:
        """Points, seeds and images of a shard, evenly from its renders."""
        x, images = self._read(shard)
        rows = sorted({k * len(x) // most for k in range(most)}) if len(x) else []
        drawn, seeds = self.parameters(shard), self.noise_seeds(shard)
        nearest = [int(np.abs(drawn - x[row]).max(axis=1).argmin()) for row in rows]
        return x[rows], [seeds[i] for i in nearest], images[rows]

    def remove(self, shards: Sequence[int]) -> None:
        """Remove shards, so that they are missing."""
        for shard in shards:
            self._path(shard).unlink(missing_ok=True)

    def remove_image(self, image: Pixels) -> None:
        """Remove the shards of which all renders are this image (H, W, 3).

        Raises CheckpointError for a shard that is damaged.
        """
        equal = partial(np.array_equal, image)
        self.remove([shard for shard in self._all() if all(map(equal, self._read(shard)[1]))])

    def failed(self, renders: int) -> dict[int, int]:
        """How many renders have failed, in whatever call, of each shard where some have.

        Raises CheckpointError for a shard that is damaged.
        """
        found = {i: SHARD - len(self._load(i, "x")["x"]) for i in self._present(renders)}
        return {i: number for i, number in found.items() if number}

    def _present(self, renders: int) -> list[int]:
        return [i for i in range(-(-renders // SHARD)) if self._path(i).exists()]

    def read(self, renders: int) -> tuple[Float64, Pixels]:
        """Parameters (n, d) and images (n, H, W, 3) of the shards that are there.

        Raises CheckpointError for a shard that is damaged.
        """
        parts = [self._read(i) for i in self._present(renders)]
        x = np.concatenate([x for x, _ in parts]) if parts else np.empty((0, self.settings["dim"]))
        images = np.empty((len(x), *self.size, self.channels), np.uint8)
        start = 0
        while parts:  # each is dropped when it was copied
            _, some = parts.pop(0)
            images[start : start + len(some)] = some
            start += len(some)
        return x[:renders], images[:renders]

    def _all(self) -> list[int]:
        """Numbers of all shards that are there."""
        stems = [path.stem for path in self.folder.glob("*.npz")]
        return sorted(int(stem) for stem in stems if _NUMBER.fullmatch(stem))  # others are foreign

    def _read(self, shard: int) -> tuple[Float64, Pixels]:
        arrays = self._load(shard, "x", "images")
        x, images = arrays["x"], arrays["images"]
        if x.shape != (len(x), self.settings["dim"]) or images.shape != (
            len(x),
            *self.size,
            self.channels,
        ):
            path = self._path(shard)
            raise CheckpointError(f"{path}: of another space or size; delete it to render again")
        return x, images

    def _load(self, shard: int, *names: str) -> dict[str, Any]:
        """Arrays of a shard by name; raises CheckpointError."""
        path = self._path(shard)
        try:
            with open_regular(path) as raw, np.load(raw, allow_pickle=False) as file:
                return {name: file[name] for name in names}
        except Exception as error:  # decoders of untrusted bytes raise nearly anything
            raise CheckpointError(
                f"{path}: damaged ({error}); delete it to render again"
            ) from error

    @property
    def _file(self) -> Path:
        return self.folder / "settings"

    def _path(self, shard: int) -> Path:
        return self.folder / f"{shard:06d}.npz"


@contextmanager
def folder_of(out: str | os.PathLike[str] | None) -> Iterator[Path]:
    """Folder of the renders that a model is learned from: beside its file `out`.

    It is a temporary one, which is removed, where nothing is kept (None).

    It is locked, for two calls that write there would remove each other's temporary files.

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
    with locked(folder / _LOCK, remove=True) as mine:
        if not mine:
            raise OptionError(
                f"the model {os.fspath(out)} is being learned, in another process or in this one; "
                "wait until that ends or stop it, and go on then, or name another file"
            )
        remove_leftovers(folder)  # of nobody who still writes
        yield folder


def check_room(settings: Mapping[str, Any], renders: int, limit: float) -> None:
    """Raise OptionError if so many renders would exceed a limit, bytes."""
    height, width = settings["size"]
    size = renders * height * width * (4 if settings.get("coverage") else 3)
    if size > limit:
        raise OptionError(
            f"{renders:,} renders of {width} x {height} pixels take {size / 2**30:.3g} GiB, and "
            f"the limit is {limit / 2**30:.3g} GiB: take fewer renders or a smaller size, or raise "
            "store_limit"
        )


def _check_same(folder: Path, there: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
    """Raise OptionError unless the settings are the same."""
    differences = list(_differences(there, asked))
    if differences:
        raise OptionError(
            f"{folder} holds other renders: {'; '.join(differences)}; name another file, or "
            "delete the folder"
        )


def _differences(there: Mapping[str, Any], asked: Mapping[str, Any]) -> Iterator[str]:
    for name in sorted({*there, *asked}):
        old, new = there.get(name), asked.get(name)
        if old != new:
            yield f"its {name} is {old!r}, not {new!r}"


# -- identity --------------------------------------------------------------------------------------


_POINTS = 8  # of which every second one decides where nothing is noisy
_AGAIN = 4  # renders of each for its noise
_SEED = 2**80  # between the seeds of noise of those renders
_ROUNDING = 1  # of 255: other processors round otherwise
_FLIPPED = 1e-3  # of all values: without antialiasing, rounding puts an edge into the next pixel
_NOISY = 2.0  # times the noise: by chance 2 of 1,000 checks exceed it where noise is one number an
# image (an exposure), and none of 1,000 where it is of pixels; 7 of 300 where 60 % of renders fail
_COARSE = 8  # pixels along a side that are averaged: the noise of single pixels hides little there


def version_for(renderer: BatchRenderer, version: str | None) -> str | None:
    """Version that was given, or else the one that the renderer states.

    Raises OptionError unless both are the same text, where there are both.
    """
    given = check_version(version, "version")
    own = version_of(renderer.source)
    if given is not None and own is not None and given != own:
        raise OptionError(
            f"version is {given!r}, and the renderer {renderer.name} states {own!r}: leave out "
            "version, or change that of the renderer"
        )
    return own if given is None else given


def check_images(store: RenderStore, renderer: BatchRenderer, more: bool) -> None:
    """Raise OptionError if the renderer's images are no longer those of a store.

    more: whether the store's images will be learned together with new ones.  Without, nothing is
        rendered unless a version is stated for the first time, or the source of the renderer was
        changed and no version vouches for it.

    Four renders where nothing has changed, nothing is noisy and at most half of them fail;
    otherwise 32 more, and RenderError if three in four of these fail.  OSError if the folder cannot
    be written.  Not noticed is what changes less than a thousandth of all values, such as a small
    object, or less than the noise.
    """
    now = fingerprint_of(renderer.source)
    stated = store.settings.get("version") != store.version
    vouched = store.version is not None  # the store compares versions itself
    if more or stated or (not vouched and changed(store.fingerprint, now)):
        x, seeds, images = store.examples(_POINTS)
        if len(x):
            _compare(store, renderer, x, seeds, images)
    if stated or (now is not None and now != store.fingerprint):
        store.accept(now or store.fingerprint)


def _compare(
    store: RenderStore, renderer: BatchRenderer, x: Float64, seeds: Sequence[int], images: Pixels
) -> None:
    """Raise OptionError if images (n, H, W, 3) of points (n, d) are not those of the renderer."""
    few = slice(None, None, 2)
    drawn, _ = _images(store, renderer, x[few], [seeds[few]])
    enough = _present(drawn).mean() >= 0.5
    if enough and _equal(drawn[0], images[few]):
        return
    again = [[seed + k * _SEED for seed in seeds] for k in range(1, 1 + _AGAIN)]
    drawn, failure = _images(store, renderer, x, again)
    if _present(drawn).sum() <= len(x):  # with more there is a point with two, which tell the noise
        raise RenderError(
            f"{renderer.name} failed for most parameters that were rendered again, of which "
            f"{store.folder} has images; mend the renderer, or delete the folder if it is of "
            f"another one: {failure}"
        )
    if not enough and _equal(drawn, images):
        return
    fine = _distances(images, drawn)
    coarse = _distances(_averaged(images), np.array([_averaged(some) for some in drawn]))
    for difference, noise in (fine, coarse):
        if difference > _NOISY * noise:
            raise OptionError(
                f"the renderer's images are not those in {store.folder}: they differ by "
                f"{difference:.2g} of 255 on average, and its noise is {noise:.2g}; delete the "
                "folder, or learn into another file"
            )


def _images(
    store: RenderStore, renderer: BatchRenderer, x: Float64, seeds: Sequence[Sequence[int]]
) -> tuple[Float64, str | None]:
    """Images (k, n, H, W, 3) in units of 1 / 255 of points (n, d), and why a render failed, if any.

    seeds: of the noise, (k, n).  An image whose render failed is NaN.
    """
    images, failure = np.full((len(seeds), len(x), *store.size, store.channels), np.nan), None
    for some, of_seed in zip(images, seeds, strict=True):
        for place, image in zip(some, renderer.small(x, of_seed, store.size), strict=True):
            if isinstance(image, Failed):
                failure = image.reason
            else:
                place[:] = image
    return images, failure


def _present(images: Float64) -> Mask:
    """Which images (..., H, W, 3) are there, (...)."""
    return ~np.isnan(images[..., 0, 0, 0])


def _equal(one: Float64, other: Pixels) -> bool:
    """Whether images (..., n, H, W, 3) that are there are (n, H, W, 3) but for rounding."""
    differences = np.abs(one - other)[_present(one)]
    return float((differences > _ROUNDING).mean()) <= _FLIPPED


def _distances(stored: Float64 | Pixels, drawn: Float64) -> tuple[float, float]:
    """Mean difference of stored images (n, ...) from new ones (k, n, ...), and of the new ones."""
    pairs = [drawn[i] - drawn[j] for i in range(len(drawn)) for j in range(i)]
    return float(np.nanmean(np.abs(drawn - stored))), float(np.nanmean(np.abs(pairs)))


def _averaged(images: Float64 | Pixels) -> Float64:
    """Images (n, h, w, 3) of the means of neighboring pixels of (n, H, W, 3)."""
    height, width = (-(-side // _COARSE) for side in images.shape[1:3])
    small = [resized(image.astype(np.float32), (height, width)) for image in images]
    return np.array(small, np.float64)
