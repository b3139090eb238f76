"""Images of trials: their loss, their features in 1,750 characters, and artifacts.

All workers that know the target read the same features from the storage.

Notation
--------
======  ==============  ============================================================================
symbol  shape           meaning
======  ==============  ============================================================================
e, e*   (T, C)          tokens of an image, and of the target
d       (T, C)          their difference, e - e*
l                       number of leading channels, such as the mean colors of `dense`, which are
                        stored as they are
P       (k, C - l)      random orthonormal rows, always the same; P^T P is a projection
u                       root mean square of e* in the channels concerned; 1 if that is zero
======  ==============  ============================================================================

What is stored: d in the leading channels, one byte a number, and P d of the other channels, half a
byte a number.  k is as large as fits into 1,300 bytes.  (If all channels fit with one byte each,
they are stored like that.)  A proposer uses only scalar products of features; those of projected
features equal those of the features within the subspace, and the target is projected alike.

A number d is quantized to a whole number q, in steps that grow with the distance from the target:

    q = round(n asinh(d / s) / asinh(R / s)),   n = 127, s = u / 64, R = 32 u   for one byte,
                                                n = 7,   s = u / 8,  R = 16 u   for half a byte.

With one byte the steps are 0.001 u near zero and 7 % of d far from it.  An image equal to the
target is stored without error, and equal patches of two images are equal in storage.

More than 1,300 tokens are averaged in runs of neighbors.

Optuna records an artifact before it stores the artifact, and a store may lose one.  If an image
cannot be read, for whatever reason, its trial counts without it.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import io
import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import asinh, ceil
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from optuna.artifacts import get_all_artifact_meta, upload_artifact
from optuna.storages import BaseStorage
from optuna.trial import FrozenTrial, Trial
from PIL import Image
from torch import Tensor

from fide_adapters.image_loss import ImageReader
from fide_adapters.optuna.storage import WarnOnce
from fide_plugins.errors import OptionError
from fide_plugins.evaluation import Evaluator
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.pixels import warn_clipped
from fide_plugins.validation.tensors import as_features
from fide_plugins.views import Views

__all__ = ["BYTES", "Codec", "ImageArtifacts", "ImageEvaluator"]

BYTES = 1300
"""Most bytes of an image; four characters of base64 hold three bytes."""

_FORMAT = "1"
_ARTIFACTS = "artifacts:"  # Optuna's attributes
_MOST_BYTES = 2**28  # of an artifact
_Levels = npt.NDArray[np.int8]


@dataclass(frozen=True, eq=False)
class _Group:
    """Some channels, and how they are stored.

    basis: (k, C), maps a token to the numbers that are stored.
    unit: u.
    fine: whether a number takes one byte, and not half a byte.
    """

    basis: Float64
    unit: float
    fine: bool

    @cached_property
    def _quantizer(self) -> tuple[int, float, float]:
        """Largest level n, scale s, and width of a step in asinh(d / s)."""
        n, s, largest = (127, 1 / 64, 32.0) if self.fine else (7, 1 / 8, 16.0)
        return n, s * self.unit, asinh(largest / s) / n

    def levels(self, difference: Float64) -> _Levels:
        """Quantized levels (S, k) of differences (S, C)."""
        n, s, step = self._quantizer
        levels = np.rint(np.arcsinh(difference @ self.basis.T / s) / step)
        return np.clip(levels, -n, n).astype(np.int8)

    def difference(self, levels: _Levels) -> Float64:
        """Differences (S, C) that the levels (S, k) stand for."""
        _, s, step = self._quantizer
        difference: Float64 = (np.sinh(levels.astype(np.float64) * step) * s) @ self.basis
        return difference

    def size(self, tokens: int) -> int:
        """Bytes of so many tokens."""
        numbers = tokens * len(self.basis)
        return numbers if self.fine else (numbers + 1) // 2

    def to_bytes(self, levels: _Levels) -> bytes:
        """Levels (S, k), one or two in a byte."""
        flat = levels.ravel()
        if self.fine:
            return flat.tobytes()
        pairs = np.append(flat, np.zeros(len(flat) % 2, np.int8)).reshape(-1, 2)
        return (pairs[:, 0] * 16 + (pairs[:, 1] & 15)).astype(np.uint8).tobytes()

    def from_bytes(self, data: bytes, tokens: int) -> _Levels:
        """Undo `to_bytes`; any bytes of the right number are valid levels."""
        flat = np.frombuffer(data, np.int8)
        if not self.fine:
            both = np.stack([flat >> 4, ((flat & 15) ^ 8) - 8], axis=1)  # of four bits, signed
            flat = both.ravel()[: tokens * len(self.basis)]
        return flat.reshape(tokens, len(self.basis))


class Codec:
    """Stores tokens of images of one size, by one encoder, for one target.

    target_tokens: (T, C), e*.
    leading: number of channels to keep as they are, as far as there is room; None: no channel is
        special.
    names: everything that the features depend on; codecs with equal names read each other's codes.
    """

    def __init__(self, target_tokens: Tensor, leading: int | None, *names: str | bytes) -> None:
        self._target = _as_array(target_tokens)
        tokens = len(self._target)
        self._run = ceil(tokens / BYTES)
        self._stored = ceil(tokens / self._run)
        self._groups = _groups(self._target, leading or 0, 8 * BYTES // self._stored)
        text = [n if isinstance(n, bytes) else n.encode() for n in (_FORMAT, *names)]
        self.digest = hashlib.blake2b(b"\0".join(text), digest_size=4).hexdigest()
        """Eight characters, equal for codecs that read each other's codes."""

    def pack(self, tokens: Tensor) -> str:
        """Code of the tokens (T, C) of an image."""
        difference = self._averaged(_as_array(tokens) - self._target)
        data = b"".join(group.to_bytes(group.levels(difference)) for group in self._groups)
        return base64.b64encode(data).decode("ascii")

    def unpack(self, code: str) -> Tensor | None:
        """Tokens float32 (T, C), approximately, of a code; None if the code is not valid."""
        try:
            data = base64.b64decode(code, validate=True)
        except (binascii.Error, ValueError):
            return None
        sizes = [group.size(self._stored) for group in self._groups]
        if len(data) != sum(sizes):
            return None
        difference = np.zeros((self._stored, self._target.shape[1]))
        for group, size in zip(self._groups, sizes, strict=True):
            difference += group.difference(group.from_bytes(data[:size], self._stored))
            data = data[size:]
        spread = np.repeat(difference, self._run, axis=0)[: len(self._target)]
        return torch.from_numpy((self._target + spread).astype(np.float32))

    def _averaged(self, difference: Float64) -> Float64:
        """Means of runs of tokens, (S, C)."""
        if self._run == 1:
            return difference
        starts = range(0, len(difference), self._run)
        return np.stack([difference[i : i + self._run].mean(axis=0) for i in starts])


def _as_array(tokens: Tensor) -> Float64:
    return tokens.detach().cpu().numpy().astype(np.float64)


def _groups(target: Float64, leading: int, bits: int) -> list[_Group]:
    """How to store C channels with so many bits a token, at least 8."""
    channels = target.shape[1]
    identity = np.eye(channels)
    fine = 8 * channels <= bits
    first = min(leading, channels, bits // 8)
    room = channels - first if fine else (bits - 8 * first) // 4
    groups = [_Group(identity[:first], _rms(target[:, :first]), True)] if first else []
    if room and first < channels:
        rest = identity[first:] if room >= channels - first else _projection(first, room, channels)
        groups.append(_Group(rest, _rms(target[:, first:]), fine))
    return groups


def _projection(first: int, rows: int, channels: int) -> Float64:
    """Orthonormal rows (rows, channels) that are zero in the first channels; always the same."""
    noise = np.random.default_rng(0).standard_normal((channels - first, rows))
    q, r = np.linalg.qr(noise)
    basis = np.zeros((rows, channels))
    basis[:, first:] = (q * np.sign(np.diag(r))).T
    return basis


def _rms(values: Float64) -> float:
    """Root mean square; 1 if that is zero."""
    mean = float(np.square(values).mean()) if values.size else 0.0
    return mean**0.5 or 1.0


class ImageEvaluator:
    """Loss and features of images, by the encoder and the loss that all optimizers share.

    make: makes the evaluator of FIDE, again after this object was unpickled.
    """

    def __init__(self, make: Callable[[], Evaluator]) -> None:
        self._make = make
        self.read = ImageReader(self.evaluator.views)
        """Canonical batch (1, H, W, 3) of an image of the target's size, packed if several."""

    @cached_property
    def evaluator(self) -> Evaluator:
        """Target, encoder and loss."""
        return self._make()

    @cached_property
    def codec(self) -> Codec:
        """How features are stored."""
        encoder, target = self.evaluator.encoder, self.evaluator.target
        return Codec(
            self.evaluator.target_tokens,
            encoder.channel_subsets[0],
            encoder.version,
            str(target.shape),
            hashlib.blake2b(target.tobytes()).digest(),
        )

    @cached_property
    def problem(self) -> str:
        """Four characters; losses of two samplers can be compared only where these are equal.

        They depend on the targets, the weights of their pixels and the name of the loss.  A user's
        own loss has no name, so all of them are taken for the same one.
        """
        views, name = self.evaluator.views, self.evaluator.loss_name
        text = json.dumps([name, views.listed, [view.target.shape for view in views.views]])
        digest = hashlib.blake2b(text.encode(), digest_size=3)
        for view in views.views:
            digest.update(view.target.tobytes())
            digest.update(b"-" if view.weights is None else view.weights.tobytes())
        return base64.b64encode(digest.digest()).decode("ascii")

    def loss(self, image: Float32) -> float:
        """Loss of a canonical image (1, H, W, 3)."""
        return float(self.evaluator.evaluate(1, image, encode=False).losses[0])

    def tokens(self, image: Float32) -> Tensor:
        """Features (T, C) of a canonical image (1, H, W, 3)."""
        tokens = self.evaluator.evaluate(1, image, [0.0]).tokens
        assert tokens is not None
        return tokens[0]

    def check(self, features: object, version: str | None = None) -> Tensor:
        """Features (T, C) from the user's (T, C) or (1, T, C); raises `FeaturesError`.

        version: of the encoder that made them, if it is known.
        """
        if np.ndim(features) != 3:  # type: ignore[arg-type]
            features = [features]
        shape = (1, *self.evaluator.features_shape)
        return as_features(features, shape, self.evaluator.encoder, version=version)[0]

    def __getstate__(self) -> dict[str, object]:
        made_when_needed = ("evaluator", "codec")
        return {
            name: value for name, value in self.__dict__.items() if name not in made_when_needed
        }


class ImageArtifacts:
    """The images in one artifact store.

    store: an `optuna.artifacts` store.
    warnings: where an image is reported that is recorded and cannot be read.

    Raises OptionError, a ValueError, for what is no store.
    """

    def __init__(self, store: Any, warnings: WarnOnce) -> None:
        if not (hasattr(store, "write") and hasattr(store, "open_reader")):
            raise OptionError(
                "artifact_store must be one of optuna.artifacts, such as "
                f"FileSystemArtifactStore(folder), not {store!r}"
            )
        self._store, self._warnings = store, warnings

    def save(self, trial: Trial, images: list[Float32]) -> None:
        """Upload the image (1, H, W, 3) of each view as 8-bit PNG, which Optuna Dashboard shows."""
        with tempfile.TemporaryDirectory(prefix="fide-") as folder:
            for name, image in zip(_names(len(images)), images, strict=True):
                path = Path(folder, name)
                Image.fromarray(np.round(image[0] * 255).astype(np.uint8)).save(path)
                upload_artifact(
                    artifact_store=self._store,
                    file_path=str(path),
                    study_or_trial=trial,
                    mimetype="image/png",
                )

    def load(self, trial: FrozenTrial, storage: BaseStorage, views: Views) -> Float32 | None:
        """Image (1, H, W, 3) of a trial, packed if there are several views; None if there is none.

        Of one view it is the first image; those of several views have the names that `save` gives.
        """
        if not any(key.startswith(_ARTIFACTS) for key in trial.system_attrs):
            return None
        try:
            metas = get_all_artifact_meta(trial, storage=storage)
            found = [meta for meta in metas if str(meta.mimetype).startswith("image/")]
            if views.listed:
                by_name = {meta.filename: meta for meta in found}
                found = [by_name[name] for name in _names(len(views.views)) if name in by_name]
            if found:
                images = [self._image(meta.artifact_id) for meta in found]
                image = images if views.listed else images[0]
                return views.canonical.batch_of_one(image, warn_clipped)  # `save` has scaled it
        except Exception as error:  # whatever the store's client or PIL raises
            self._warnings.warn(
                "artifacts",
                f"the image of trial {trial.number} in the artifact store cannot be used, so the "
                f"trial counts without it: {error or type(error).__name__}",
            )
        return None

    def _image(self, name: object) -> Any:
        if not isinstance(name, str) or PurePath(name).name != name:
            raise ValueError(f"not the id of an artifact: {name!r}")  # a path could lead anywhere
        with self._store.open_reader(name) as reader:
            return Image.open(io.BytesIO(reader.read(_MOST_BYTES)))


def _names(views: int) -> list[str]:
    """File names of the images of so many views."""
    return ["image.png"] if views == 1 else [f"image-{i}.png" for i in range(views)]
