"""Features of an image in 1,750 characters, the same for everybody who knows the target.

Notation
--------
======  ==============  ============================================================================
symbol  shape           meaning
======  ==============  ============================================================================
e, e*   (T, C)          tokens of an image, and of the target
d       (T, C)          their difference, e - e*
l                       leading channels, such as the mean colors of `dense`: kept as they are
P       (k, C - l)      orthonormal rows, drawn once and for all; P^T P is a projection
u                       root mean square of e* in the channels concerned; 1 if that is zero
======  ==============  ============================================================================

Stored are d in the leading channels, a byte each, and P d of the others, half a byte each; k is
what fits into 1,300 bytes.  (If all channels fit with a byte each, they are stored like that.)  Who
learns from features needs their scalar products only: those of projections are those of the whole
in the plane that is kept, and of the target the plane sees the same part.

A number d becomes a whole number q with the steps growing from its center, where the target is:

    q = round(n asinh(d / s) / asinh(R / s)),   n = 127, s = u / 64, R = 32 u   for a byte,
                                                n = 7,   s = u / 8,  R = 16 u   for half of one.

With a byte steps are 0.001 u next to zero and 7 % of d far from it.  Where an image equals the
target it is exactly zero, and equal patches of two images are equal in store.

More than 1,300 tokens are averaged in runs.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
from dataclasses import dataclass
from functools import cached_property
from math import asinh, ceil

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fide_plugins.points import Float64

__all__ = ["BYTES", "Codec"]

BYTES = 1300
"""Most bytes of an image; four characters hold three."""

_FORMAT = "1"
_Levels = npt.NDArray[np.int8]


@dataclass(frozen=True, eq=False)
class _Group:
    """Some channels and how they are stored.

    basis: (k, C), what is stored of a token.
    unit: u.
    fine: a byte for each, and not half of one.
    """

    basis: Float64
    unit: float
    fine: bool

    @cached_property
    def _law(self) -> tuple[int, float, float]:
        """Largest level n, s, and the growth of steps."""
        n, s, largest = (127, 1 / 64, 32.0) if self.fine else (7, 1 / 8, 16.0)
        return n, s * self.unit, asinh(largest / s) / n

    def levels(self, difference: Float64) -> _Levels:
        """Whole numbers (S, k) of differences (S, C)."""
        n, s, step = self._law
        levels = np.rint(np.arcsinh(difference @ self.basis.T / s) / step)
        return np.clip(levels, -n, n).astype(np.int8)

    def difference(self, levels: _Levels) -> Float64:
        """Undo `levels`, as far as that is possible, (S, C)."""
        _, s, step = self._law
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
        """Undo `to_bytes`; any bytes of the right number are levels."""
        flat = np.frombuffer(data, np.int8)
        if not self.fine:
            both = np.stack([flat >> 4, ((flat & 15) ^ 8) - 8], axis=1)  # of four bits, signed
            flat = both.ravel()[: tokens * len(self.basis)]
        return flat.reshape(tokens, len(self.basis))


class Codec:
    """Tokens of images of one size, by one encoder, for one target.

    target_tokens: (T, C), e*.
    leading: channels to keep as they are, as far as there is room; None: no channel is special.
    names: what the features depend on; codecs are equal if these are.
    """

    def __init__(self, target_tokens: Tensor, leading: int | None, *names: str | bytes) -> None:
        self._target = _as_array(target_tokens)
        tokens = len(self._target)
        self._run = ceil(tokens / BYTES)
        self._stored = ceil(tokens / self._run)
        self._groups = _groups(self._target, leading or 0, 8 * BYTES // self._stored)
        text = [n if isinstance(n, bytes) else n.encode() for n in (_FORMAT, *names)]
        self.digest = hashlib.blake2b(b"\0".join(text), digest_size=4).hexdigest()
        """Eight characters; who has the same reads the same."""

    def pack(self, tokens: Tensor) -> str:
        """Code of the tokens (T, C) of an image."""
        difference = self._averaged(_as_array(tokens) - self._target)
        data = b"".join(group.to_bytes(group.levels(difference)) for group in self._groups)
        return base64.b64encode(data).decode("ascii")

    def unpack(self, code: str) -> Tensor | None:
        """Tokens float32 (T, C) of a code, as well as it tells; None if it is no such code."""
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
    """How C channels are stored in so many bits a token, at least 8."""
    channels = target.shape[1]
    identity = np.eye(channels)
    fine = 8 * channels <= bits
    first = min(leading, channels, bits // 8)
    room = channels - first if fine else (bits - 8 * first) // 4
    groups = [_Group(identity[:first], _rms(target[:, :first]), True)] if first else []
    if room and first < channels:
        rest = identity[first:] if room >= channels - first else _mixtures(first, room, channels)
        groups.append(_Group(rest, _rms(target[:, first:]), fine))
    return groups


def _mixtures(first: int, rows: int, channels: int) -> Float64:
    """Orthonormal rows (rows, channels) that leave out the first channels, the same for ever."""
    noise = np.random.default_rng(0).standard_normal((channels - first, rows))
    q, r = np.linalg.qr(noise)
    basis = np.zeros((rows, channels))
    basis[:, first:] = (q * np.sign(np.diag(r))).T
    return basis


def _rms(values: Float64) -> float:
    """Root mean square, or 1 where there is nothing."""
    mean = float(np.square(values).mean()) if values.size else 0.0
    return mean**0.5 or 1.0
