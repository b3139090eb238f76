"""Constants of the `perceptual` loss, of arrays and of tensors alike: see its definition there."""

from __future__ import annotations

import numpy as np

__all__ = ["COLOR_WEIGHT", "FLOOR", "LEAST", "LEVELS", "OPPONENT"]

LEVELS = 4
FLOOR = np.float32(1e-3)  # c
LEAST = 0.1  # smallest fraction of a square that remains when noise is subtracted
COLOR_WEIGHT = 4.0
# rows: Y, Cb, Cr of Rec. 601, as weights of R, G, B
OPPONENT = np.array(
    [[0.299, 0.587, 0.114], [-0.168736, -0.331264, 0.5], [0.5, -0.418688, -0.081312]], np.float32
)
