"""Methods to remove noise from the samples of `dense`: the alternatives to its smoothing.

    python benchmarks/smoothing.py

The columns are those of benchmarks/encoder_noise.py, on the same renders, and the milliseconds of
CPU time per image, with all of `dense`.  Every method except `dense` itself is applied in full,
whatever the noise of an image.  `dense` without smoothing encodes the references.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
import torch
from encoder_noise import Matrix, noise_share, of_loss, order, renders

from fide_plugins.encoders.dense import DenseEncoder, less_noisy, sampled
from fide_plugins.encoders.despeckle import despeckled
from fide_plugins.types import Float32

Step = Callable[[Float32], Float32]  # of an image, or of samples
SAMPLES = 28


def median_of_5(image: Float32) -> Float32:
    return np.asarray(cv2.medianBlur(image, 5), np.float32)


def bilateral(tones: float, reach: int = 7) -> Step:
    return lambda x: np.asarray(cv2.bilateralFilter(x, reach, tones, reach / 2), np.float32)


def gaussian(scale: float) -> Step:
    return lambda x: np.asarray(cv2.GaussianBlur(x, (0, 0), scale), np.float32)


def guided(contrast: float, side: int = 7) -> Step:
    """The guided filter, an image guiding itself (He, Sun & Tang 2010)."""

    def smooth(x: Float32) -> Float32:
        mean = cv2.blur(x, (side, side))
        variance = cv2.blur(x * x, (side, side)) - mean * mean
        gain = variance / (variance + np.float32(contrast**2))
        offset = cv2.blur(mean * (1 - gain), (side, side))
        return np.asarray(cv2.blur(gain, (side, side)) * x + offset, np.float32)

    return smooth


def wiener(image: Float32) -> Float32:
    """Toward the local mean by the share that noise has of the local variance (Lee 1980)."""
    clean = despeckled(image)
    grain = cv2.GaussianBlur(area(np.abs(image - clean)).mean(axis=2), (0, 0), 1.5)
    x = area(clean)
    mean = cv2.blur(x, (3, 3))
    variance = (cv2.blur(x * x, (3, 3)) - mean * mean).mean(axis=2).clip(1e-12)
    gain = (variance - np.square(grain)).clip(0) / variance
    return np.asarray(mean + gain[..., None] * (x - mean), np.float32)


def with_specks_spread(image: Float32) -> Float32:
    """What despeckling took out goes back, as the mean of a wide surrounding."""
    clean = area(despeckled(image))
    return clean + gaussian(2.0)(area(image) - clean)


def nonlocal_means(x: Float32, contrast: float = 0.08, reach: int = 2) -> Float32:
    """Mean of samples whose 3 x 3 look alike (Buades, Coll & Morel 2005)."""
    total, weights = x.copy(), np.ones(x.shape[:2], np.float32)
    padded = np.pad(x, ((reach, reach), (reach, reach), (0, 0)), mode="reflect")
    for i, j in shifts(reach):
        other = padded[reach + i :, reach + j :][: len(x), : x.shape[1]]
        apart = cv2.blur(np.square(other - x).mean(axis=2), (3, 3))
        weight = np.exp(-apart / np.float32(contrast**2))
        total += weight[..., None] * other
        weights += weight
    return total / weights[..., None]


def shifts(reach: int) -> Iterator[tuple[int, int]]:
    around = range(-reach, reach + 1)
    return ((i, j) for i in around for j in around if (i, j) != (0, 0))


def area(image: Float32) -> Float32:
    return sampled(image, SAMPLES, SAMPLES)


def chain(*steps: Step) -> Step:
    """All steps, one after the other."""

    def run(x: Float32) -> Float32:
        for step in steps:
            x = step(x)
        return x

    return run


once = chain(despeckled, area)
twice = chain(despeckled, despeckled, area)
harder = chain(despeckled, median_of_5, area)
WAYS: dict[str, Step] = {
    "despeckled, as version 3": once,
    "not despeckled": area,
    "despeckled twice": twice,
    "despeckled, then medians of 5 x 5": harder,
    "guided filter of the despeckled pixels": chain(despeckled, guided(0.1), area),
    "specks spread": with_specks_spread,
    "local Wiener filter": wiener,
    "Gaussian of 1 sample": chain(once, gaussian(1.0)),
    "Gaussian of 1.4 samples": chain(once, gaussian(1.4)),
    "non-local means": chain(once, nonlocal_means),
    "medians of 5 x 5, non-local means": chain(harder, nonlocal_means),
    "medians of 5 x 5, bilateral": chain(harder, bilateral(0.25, 5)),
    "bilateral": chain(once, bilateral(0.5)),
    "despeckled twice, bilateral, finer tones": chain(twice, bilateral(0.3)),
    "despeckled twice, bilateral": chain(twice, bilateral(0.5)),
    "despeckled twice, bilateral, coarser tones": chain(twice, bilateral(0.8)),
    "`dense`: that, as far as an image is noisy": lambda x: less_noisy(x, SAMPLES, SAMPLES),
}


def tokens(way: Step, images: Float32) -> torch.Tensor:
    samples = np.stack([way(image) for image in images]).clip(0, 1)
    return DenseEncoder()._encode(torch.from_numpy(samples)).flatten(1).double()


def distances(a: torch.Tensor, b: torch.Tensor) -> Matrix:
    found: Matrix = torch.cdist(a, b).numpy()
    return found


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    one, two, reference = renders(112)
    true, targets = of_loss("mse")(reference, reference), tokens(once, reference)
    print("| way | ms | noise / difference | order |\n|---|---:|---:|---:|")
    for name, way in WAYS.items():
        start = time.process_time()
        noisy = [tokens(way, images) for images in (one, two)]
        ms = 1e3 * (time.process_time() - start) / (2 * len(one))
        kept = np.mean([order(distances(e, targets), true) for e in noisy])
        share = noise_share(distances(*noisy))
        print(f"| {name} | {ms:.2f} | {share:.3f} | {kept:.2f} |", flush=True)


if __name__ == "__main__":
    main()
