"""The `dense` encoder: hand-made features of a grid of patches, without weights.

The image (H, W) is despeckled: from 84 x 84 pixels on each pixel becomes the median of its 3 x 3,
since most of the noise of path tracing is in a few bright pixels.  Then it is averaged, exactly, to
2 gh x 2 gw samples of gh x gw patches.  A second set of samples is taken from the image despeckled
twice, and smoothed by a bilateral filter (Tomasi & Manduchi 1998).  The features use (1 - w) times
the first set plus w times the second; w grows with the noise level, the median over pixels of what
the first median changed, from 0 at half a step of 8 bits to 1 at 0.015.

Channels of a token (C = 16)

======  ======================================================================  ============
0-2     mean R, G, B                                                            [0, 1]
3-5     right half minus left half of the patch, for R, G, B                    [-1, 1]
6-8     lower half minus upper half                                             [-1, 1]
9-11    one diagonal pair of quarters minus the other (upper left positive)     [-1, 1]
12-15   edges of the luminance: vertical, horizontal, along the main diagonal,  [0, sqrt 2]
        along the other
======  ======================================================================  ============

Edges: with g the gradient of the luminance and theta its angle, |g| cos 2 theta and |g| sin 2 theta
are each split into positive and negative part and averaged over the patch.
"""

from __future__ import annotations

from functools import lru_cache
from math import sqrt

import numpy as np
import torch

from fide_plugins.encoders.base import PatchEncoder
from fide_plugins.runtime.opencv import cv2
from fide_plugins.runtime.threads import one_thread
from fide_plugins.types import Float32

SIDE = 14  # patches along the side of a square image
MAX_TOKENS = 256
SAMPLES = 2
CHANNELS = 16
LUMINANCE = (0.299, 0.587, 0.114)  # Rec. 601
SMALLEST = 84  # pixels; images with smaller sqrt(H W) may consist of lines, and are not despeckled
ROWS = 28  # least number of pixel rows that tell the noise level, if there are as many
FAINT = 0.002  # noise level up to which samples are not smoothed (w = 0)
NOISY = 0.015  # noise level above which samples are fully smoothed (w = 1)
REACH = 7  # diameter of the bilateral filter: 7 samples, 3.5 patches
TONES = 0.5  # its standard deviation for colors, R, G and B together


def grid(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of patches for an image of that size.

    14 sqrt(H/W) rows and 14 sqrt(W/H) columns, rounded, so that patches are square; at least one,
    at most one per pixel; the longer side is reduced until there are at most 256 patches.

    >>> grid(224, 224), grid(480, 640), grid(16, 4096), grid(1, 1)
    ((14, 14), (12, 16), (1, 224), (1, 1))
    """
    rows = min(max(round(SIDE * sqrt(height / width)), 1), height)
    columns = min(max(round(SIDE * sqrt(width / height)), 1), width)
    if rows >= columns:
        return min(rows, MAX_TOKENS // columns), columns
    return rows, min(columns, MAX_TOKENS // rows)


@lru_cache(maxsize=64)
def box_weights(pixels: int, boxes: int) -> Float32:
    """Weights (boxes, pixels) of the means over equal parts of a row: the share of each pixel."""
    edges = np.arange(boxes + 1) * (pixels / boxes)
    left = np.arange(pixels)
    overlap = np.minimum(edges[1:, None], left + 1) - np.maximum(edges[:-1, None], left)
    weights: Float32 = (np.maximum(overlap, 0) * (boxes / pixels)).astype(np.float32)
    return weights


def sampled(image: Float32, rows: int, columns: int) -> Float32:
    """Means (rows, columns, 3) over equal boxes of an image (H, W, 3), which may cut pixels."""
    height, width, _ = image.shape
    if rows <= height and columns <= width:  # then this is exactly that
        area = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA)
        return np.asarray(area, np.float32)
    down, across = box_weights(height, rows), box_weights(width, columns)
    with np.errstate(under="ignore"):  # what is too small for float32 is 0
        means: Float32 = np.einsum("rh,hwc,vw->rvc", down, image, across, optimize=True)
    return means


def despeckled(image: Float32) -> Float32:
    """Medians of 3 x 3 pixels of an image (H, W, 3); the image itself if it is small."""
    if image.shape[0] * image.shape[1] < SMALLEST**2:
        return image
    return np.asarray(cv2.medianBlur(np.ascontiguousarray(image), 3), np.float32)


def noise_level(image: Float32, clean: Float32) -> float:
    """Median over pixels of some rows of the largest color difference of two images (H, W, 3).

    0 where it is below `FAINT`.
    """
    step = max(1, len(image) // ROWS)
    apart = np.abs(image[::step] - clean[::step])
    largest = np.maximum(np.maximum(apart[..., 0], apart[..., 1]), apart[..., 2]).ravel()
    if np.count_nonzero(largest < FAINT) > len(largest) // 2:  # most renders have none
        return 0.0
    return float(np.sort(largest)[len(largest) // 2])  # np.partition is ten times slower with ties


def less_noisy(image: Float32, rows: int, columns: int) -> Float32:
    """Samples (rows, columns, 3) of an image (H, W, 3), smoothed according to its noise level."""
    clean = despeckled(image)
    samples = sampled(clean, rows, columns)
    if clean is image:
        return samples
    w = min(1.0, (noise_level(image, clean) - FAINT) / (NOISY - FAINT))
    if w <= 0.0:
        return samples
    cleaner = sampled(despeckled(clean), rows, columns)
    smooth = cv2.bilateralFilter(cleaner, REACH, TONES, REACH / 2)
    return samples + np.float32(w) * (np.asarray(smooth, np.float32) - samples)


class DenseEncoder(PatchEncoder):
    """Mean color, color contrasts and edge energies of patches; see the module for the channels."""

    name = "dense"
    uses_network = False
    version = "dense-4"
    channel_subsets = (3, None)  # colors alone, and with edges
    threads = one_thread

    def shape(self, height: int, width: int) -> tuple[int, int]:
        """(T, C) = (gh gw, 16)."""
        rows, columns = grid(height, width)
        return rows * columns, CHANNELS

    def _prepare(self, batch: Float32) -> Float32:
        rows, columns = grid(batch.shape[1], batch.shape[2])
        samples = np.empty((len(batch), SAMPLES * rows, SAMPLES * columns, 3), np.float32)
        for i, image in enumerate(batch):
            samples[i] = less_noisy(image, *samples.shape[1:3])
        return samples.clip(0.0, 1.0, out=samples)

    def _encode(self, images: torch.Tensor) -> torch.Tensor:
        samples = images.permute(0, 3, 1, 2).contiguous()  # (n, 3, 2 gh, 2 gw)
        top, bottom = samples[..., ::2, :], samples[..., 1::2, :]
        a, b, c, d = top[..., ::2], top[..., 1::2], bottom[..., ::2], bottom[..., 1::2]
        mean = ((a + d) + (b + c)) / 4  # (n, 3, gh, gw), as the three differences
        haar = ((b + d) - (a + c)) / 2, ((c + d) - (a + b)) / 2, ((a + d) - (b + c)) / 2
        weights = torch.tensor(LUMINANCE, dtype=torch.float32).to(samples.device)[:, None, None]
        luminance = (samples * weights).sum(1)
        padded = torch.nn.functional.pad(luminance[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
        gx = padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2]
        gy = padded[:, 2:, 1:-1] - padded[:, :-2, 1:-1]
        norm = (gx.square() + gy.square()).sqrt().clamp(min=1e-12)
        along = (gx.square() - gy.square()) / norm  # |g| cos 2 theta
        across = 2 * gx * gy / norm  # |g| sin 2 theta
        # main diagonal: the gradient of an edge along it points at -45 degrees (y counts downwards)
        split = torch.stack([along, -along, -across, across], dim=1).clamp(min=0)
        edges = torch.nn.functional.avg_pool2d(split, SAMPLES)  # (n, 4, gh, gw)
        return torch.cat([mean, *haar, edges], dim=1).flatten(2).transpose(1, 2)  # (n, T, C)
