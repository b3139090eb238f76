"""A cache of tokens by the content of the image.

Networks use it: to encode an image takes them several hundred times as long as its digest.  The
hand-made encoders are as fast as the digest and have no cache.  Since the tokens of an image do not
depend on the rest of its batch, a run is the same with and without a cache.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from fide_plugins.runtime.threads import Lock
from fide_plugins.types import Float32

__all__ = ["TokenCache"]


class TokenCache:
    """Cache of tokens; evicts the least recently used tokens.

    most_bytes: largest size of all tokens together.

    Threads may share a cache.  They encode in parallel, so two threads may both encode an image
    that is new to both.
    """

    def __init__(self, most_bytes: int = 2**28) -> None:
        self.most_bytes = most_bytes
        self._tokens: OrderedDict[bytes, Tensor] = OrderedDict()  # least recently used first
        self._bytes = 0
        self._lock = Lock()  # guards the two attributes above

    def __len__(self) -> int:
        return len(self._tokens)

    def tokens(self, batch: Float32, encode: Callable[[Float32], Tensor]) -> Tensor:
        """Tokens (n, T, C) of a canonical batch (n, H, W, 3).

        encode: encodes the images that are not in the cache, each distinct image once.
        """
        keys = [_digest(image) for image in batch]
        with self._lock:
            known = {key: self._tokens[key] for key in keys if key in self._tokens}
        unknown = {key: i for i, key in enumerate(keys) if key not in known}
        if unknown or not len(batch):
            fresh = encode(batch[list(unknown.values())])
            known |= dict(zip(unknown, fresh, strict=True))
            if not len(batch):
                return fresh
        with self._lock:
            for key in keys:
                self._keep(key, known[key])
        return torch.stack([known[key] for key in keys])

    def _keep(self, key: bytes, tokens: Tensor) -> None:
        if key in self._tokens:
            self._tokens.move_to_end(key)
            return
        self._tokens[key] = tokens.clone()  # a view would keep the whole batch in memory
        self._bytes += tokens.nbytes
        while self._bytes > self.most_bytes:
            _, oldest = self._tokens.popitem(last=False)
            self._bytes -= oldest.nbytes


def _digest(image: Float32) -> bytes:
    content = hashlib.sha256(repr(image.shape).encode())
    content.update(np.ascontiguousarray(image).data)
    return content.digest()
