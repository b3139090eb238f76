"""Images of trials: their loss, and their features in 2,600 bytes.

All workers read the same features from the storage: the difference d of the tokens (T, C) of an
image from those of the target, one byte a number, of the leading channels (such as the mean colors
of `dense`) and of as many random projections of the others as there is room for,

    q = round(127 asinh(d / s) / asinh(R / s)),   s = u / 64, R = 32 u,

where u is the root mean square of the target's tokens in the channels concerned: the steps are
0.001 u near zero and 7 % of d far from it.  An image equal to the target has no error.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
from collections.abc import Callable
from functools import cached_property
from math import asinh, ceil

import numpy as np
import torch
from torch import Tensor

from fide_adapters.image_loss import ImageReader
from fide_plugins.evaluation import Evaluator
from fide_plugins.types import Float32, Float64

BYTES = 2600
"""Most bytes of an image; four characters of base64 hold three bytes."""

_FORMAT = b"2"
_LEVELS = 127
_FINEST, _LARGEST = 1 / 64, 32.0  # s / u and R / u
_STEP = asinh(_LARGEST / _FINEST) / _LEVELS  # of asinh(d / s)


class Codec:
    """Stores tokens of images of one size, by one encoder, for one target.

    target_tokens: (T, C).
    leading: number of channels to keep as they are, as far as there is room; None: no channel is
        special.
    names: everything that the features depend on; codecs with equal names read each other's codes.
    """

    def __init__(self, target_tokens: Tensor, leading: int | None, *names: bytes) -> None:
        self._target = _as_array(target_tokens)
        tokens, channels = self._target.shape
        self._run = ceil(tokens / BYTES)  # neighbors that are averaged
        self._stored = ceil(tokens / self._run)
        first = min(leading or 0, channels, room := BYTES // self._stored)
        self._basis = _basis(first, min(room, channels), channels)  # (k, C)
        units = [_rms(self._target[:, :first])] * first
        units += [_rms(self._target[:, first:])] * (len(self._basis) - first)
        self._scale = _FINEST * np.array(units)  # (k,)
        text = b"\0".join((_FORMAT, *names))
        self.digest = hashlib.blake2b(text, digest_size=4).hexdigest()
        """Eight characters, equal for codecs that read each other's codes."""

    def pack(self, tokens: Tensor) -> str:
        """Code of the tokens (T, C) of an image."""
        difference = _as_array(tokens) - self._target
        if self._run > 1:
            starts = range(0, len(difference), self._run)
            difference = np.stack([difference[i : i + self._run].mean(axis=0) for i in starts])
        levels = np.rint(np.arcsinh(difference @ self._basis.T / self._scale) / _STEP)
        levels = np.clip(levels, -_LEVELS, _LEVELS).astype(np.int8)
        return base64.b64encode(levels.tobytes()).decode("ascii")

    def unpack(self, code: str) -> Tensor | None:
        """Tokens float32 (T, C), approximately, of a code; None if the code is not valid."""
        try:
            levels = np.frombuffer(base64.b64decode(code, validate=True), np.int8)
            levels = levels.reshape(self._stored, len(self._basis))
        except (binascii.Error, ValueError):
            return None
        difference = (np.sinh(levels.astype(np.float64) * _STEP) * self._scale) @ self._basis
        spread = np.repeat(difference, self._run, axis=0)[: len(self._target)]
        return torch.from_numpy((self._target + spread).astype(np.float32))


def _as_array(tokens: Tensor) -> Float64:
    return tokens.detach().cpu().numpy().astype(np.float64)


def _basis(first: int, rows: int, channels: int) -> Float64:
    """Orthonormal rows (rows, channels): the first channels, and projections of the others."""
    basis = np.eye(rows, channels)
    if rows < channels:
        noise = np.random.default_rng(0).standard_normal((channels - first, rows - first))
        q, r = np.linalg.qr(noise)
        basis[first:, first:] = (q * np.sign(np.diag(r))).T
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
        names = (encoder.version.encode(), str(target.shape).encode(), target.tobytes())
        return Codec(self.evaluator.target_tokens, encoder.channel_subsets[0], *names)

    @cached_property
    def problem(self) -> str:
        """Four characters of the targets, the weights of pixels and the name of the loss.

        A user's own loss has no name, so all of them are taken for the same one.
        """
        views, name = self.evaluator.views, self.evaluator.loss.spec
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

    def __getstate__(self) -> dict[str, object]:
        return {name: v for name, v in self.__dict__.items() if name not in ("evaluator", "codec")}
