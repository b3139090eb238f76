"""Renders on disk: a folder of shards, each written atomically.

Shard i holds the renders of the parameters that a generator with the seed (seed, i) draws, so the
store is the same whatever the number of workers, and whatever was interrupted.

    settings          what the renders are of, a checked file (`runtime.checkpoint`), written
                      before the first shard
    000000.npz, ...   x (n, d) float64 and images (n, H, W, 3) uint8; failed renders are left out
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np

from fide_plugins.errors import CheckpointError, OptionError
from fide_plugins.fitting.rendering import Failed
from fide_plugins.learning.renders.renderer import Pixels, Small
from fide_plugins.runtime import checkpoint
from fide_plugins.runtime.files import (
    atomic_writer,
    check_writable,
    locked,
    open_regular,
    remove_leftovers,
)
from fide_plugins.types import Float64

__all__ = ["SHARD", "RenderStore", "check_room", "folder_of"]

SHARD = 100
"""Renders of a shard: what a kill loses, at most, for each worker."""

_KIND = "renders"
_LOCK = ".learn.lock"
_NUMBER = re.compile("[0-9]{6,}")
_DIGESTS = {"after": "they were made after another model", "picture": "they are of another picture"}


class RenderStore:
    """Renders of random parameters.

    folder: made if it is missing.
    settings: plain values that define the renders: "dim", "size", "seed" and more.
    fingerprint: of the renderer, for a new folder, see `runtime.registry`; None where nothing
        is known.  That of an earlier folder stays until it is replaced, see `accept`.
    draw: parameters (SHARD, d) of a shard; None: uniform in the unit cube.

    Raises OptionError if the folder holds other renders, naming the difference; OSError if it
    cannot be written.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        settings: Mapping[str, Any],
        fingerprint: str | None = None,
        draw: Callable[[int], Float64] | None = None,
    ) -> None:
        self.folder, self.settings = Path(folder), dict(settings)
        self._draw, self._drawn = draw or self._uniform, dict[int, Float64]()
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
        if self.version is None:  # one that is stated now may be that of the images, see `identity`
            there["version"] = self.settings.get("version")
        _check_same(self.folder, there, self.settings)
        self._agreed = True

    def accept(self, fingerprint: str | None) -> None:
        """Record fingerprint and version of the renderer whose images these are; or OSError."""
        checkpoint.write(self._file, _KIND, {**self.settings, "fingerprint": fingerprint})
        self.fingerprint, self.version = fingerprint, self.settings.get("version")
        self._agreed = True

    @classmethod
    def open(cls, folder: str | os.PathLike[str]) -> Self:
        """Renders of a folder as they are; raises OSError or CheckpointError."""
        settings = checkpoint.read(Path(folder) / "settings", _KIND)
        settings.pop("fingerprint", None)
        return cls(folder, settings)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the images."""
        height, width = self.settings["size"]
        return height, width

    def parameters(self, shard: int) -> Float64:
        """Parameters (SHARD, d) of a shard, the same each time."""
        if shard not in self._drawn:
            self._drawn[shard] = self._draw(shard)
        return self._drawn[shard]

    def _uniform(self, shard: int) -> Float64:
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
        pixels = np.array(kept, np.uint8).reshape(len(kept), *self.size, 3)
        if not self._agreed:
            if self._all():
                self._agree()
            else:
                self.accept(self.fingerprint)
        with atomic_writer(self._path(shard)) as file:
            np.savez(file, x=self.parameters(shard)[good], images=pixels)
        del self._drawn[shard]
        return int((~good).sum())

    def examples(self, most: int) -> tuple[Float64, list[int], Pixels]:
        """Points (n, d), seeds of the noise (n,) and images (n, H, W, 3) of some renders.

        They come from shards that are far apart; fewer than `most` where shards have lost renders.
        Raises CheckpointError for a shard that is damaged.
        """
        there = self._all()
        picked = [there[k * len(there) // most] for k in range(most)] if there else []
        parts = [self._some(shard, picked.count(shard)) for shard in dict.fromkeys(picked)]
        empty = np.empty((0, *self.size, 3), np.uint8)
        return (
            np.concatenate([np.empty((0, self.settings["dim"])), *(x for x, _, _ in parts)]),
            [seed for _, seeds, _ in parts for seed in seeds],
            np.concatenate([empty, *(images for _, _, images in parts)]),
        )

    def _some(self, shard: int, most: int) -> tuple[Float64, list[int], Pixels]:
        """Points, seeds and images of a shard, evenly from its renders."""
        x, images = self._read(shard)
        rows = sorted({k * len(x) // most for k in range(most)}) if len(x) else []
        drawn, seeds = self._draw(shard), self.noise_seeds(shard)
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
        images = np.empty((len(x), *self.size, 3), np.uint8)
        start = 0
        while parts:  # each is dropped when it was copied
            _, some = parts.pop(0)
            images[start : start + len(some)] = some
            start += len(some)
        return x[:renders], images[:renders]

    def read_all(self) -> tuple[Float64, Pixels]:
        """As `read`, of all shards."""
        return self.read(SHARD * (max(self._all(), default=-1) + 1))

    def _all(self) -> list[int]:
        """Numbers of all shards that are there."""
        stems = [path.stem for path in self.folder.glob("*.npz")]
        return sorted(int(stem) for stem in stems if _NUMBER.fullmatch(stem))  # others are foreign

    def _read(self, shard: int) -> tuple[Float64, Pixels]:
        arrays = self._load(shard, "x", "images")
        x, images = arrays["x"], arrays["images"]
        if x.shape != (len(x), self.settings["dim"]) or images.shape != (len(x), *self.size, 3):
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
    size = renders * height * width * 3
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
        if old == new:
            continue
        if name not in _DIGESTS:
            yield f"its {name} is {old!r}, not {new!r}"
        elif old is not None and new is not None:
            yield _DIGESTS[name]
        elif name == "after":  # then only one of both has a picture, too
            yield f"they are of a {'first' if old is None else 'second'} round"
