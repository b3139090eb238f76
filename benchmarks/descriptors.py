"""Alternative descriptors for the encoder `dense`.

    python benchmarks/descriptors.py noise                    # how much of a distance is noise
    python benchmarks/descriptors.py fit voronoi spline robot # FIDE with each descriptor
    python benchmarks/descriptors.py table                    # results of `fit`

`fit`: 500 renders, mean squared error, the targets and seeds of benchmarks/encoders.py.

Unless stated otherwise, all descriptors have a grid of 14 x 14 tokens and begin with the mean
colors, so the proposer uses the colors alone every second time, as with `dense`.  All except
`dense` use the despeckled image and do not smooth noisy images.  On images without noise `without
smoothing` equals `dense`.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from encoder_noise import measured, of_encoder
from encoders import measure
from quality import run_configurations
from rows import Row, read
from torch import Tensor

from fide_plugins import encoders
from fide_plugins.encoders import dense
from fide_plugins.encoders.base import PatchEncoder
from fide_plugins.encoders.despeckle import despeckled
from fide_plugins.types import Float32

RESULTS = Path(__file__).parent / "results" / "descriptors.jsonl"
BUDGET = 500  # later, a run has found the right place of every part or not, by chance

Samples = Callable[[int], Tensor]  # side of a patch in samples -> (n, 3, 14 side, 14 side)


def luminance(samples: Tensor) -> Tensor:
    """(n, h, w) of (n, 3, h, w)."""
    return (samples * samples.new_tensor(dense.LUMINANCE)[:, None, None]).sum(1)


def colors(at: Samples) -> list[Tensor]:
    """Mean colors of patches, 3 channels."""
    return [at(1)]


def quarters(at: Samples) -> list[Tensor]:
    """Mean colors and what tells the four quarters apart, 12 channels."""
    return list(dense._haar(at(2)))


def edges(at: Samples, gain: float = 1.0) -> list[Tensor]:
    """What `dense` has, 16 channels."""
    return [*quarters(at), gain * dense._edges(luminance(at(2)))]


def fine_edges(at: Samples) -> list[Tensor]:
    """Edges of half that scale too, as version 1 had, 20 channels."""
    return [*edges(at), F.avg_pool2d(dense._edges(luminance(at(4))), 2)]


def wavelets(at: Samples) -> list[Tensor]:
    """Two levels of Haar wavelets: all of 4 x 4 samples a patch, 48 channels."""
    mean, *details = dense._haar(at(4))
    finest = [F.pixel_unshuffle(detail, 2) for detail in details]
    return [*dense._haar(mean), *finest]


def blurs(at: Samples) -> list[Tensor]:
    """Colors of a wider and a still wider surrounding, 22 channels."""
    wider = [
        F.avg_pool2d(at(1), 2 * r + 1, stride=1, padding=r, count_include_pad=False) for r in (1, 3)
    ]
    return [*edges(at), *wider]


def histograms(at: Samples) -> list[Tensor]:
    """Soft histograms of each color with five tones, 31 channels."""
    tones = torch.linspace(0, 1, 7)[1:-1]
    shares = torch.sigmoid((at(4)[:, :, None] - tones[:, None, None]) / 0.08).flatten(1, 2)
    return [*edges(at), F.avg_pool2d(shares, 4)]


def orientations(at: Samples) -> list[Tensor]:
    """Gradients of the luminance in eight directions, with their sign, 20 channels."""
    y = F.pad(luminance(at(4))[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
    gx, gy = y[:, 1:-1, 2:] - y[:, 1:-1, :-2], y[:, 2:, 1:-1] - y[:, :-2, 1:-1]
    angles = torch.arange(8) * (torch.pi / 4)
    along = gx[:, None] * angles.cos()[:, None, None] + gy[:, None] * angles.sin()[:, None, None]
    return [*quarters(at), F.avg_pool2d(along.clamp(min=0), 4)]


def random_kernels(at: Samples) -> list[Tensor]:
    """Positive and negative part of 24 random 5 x 5 convolutions, averaged, 51 channels."""
    kernels = torch.randn(24, 3, 5, 5, generator=torch.Generator().manual_seed(0))
    kernels -= kernels.mean((2, 3), keepdim=True)
    kernels /= kernels.flatten(1).norm(dim=1)[:, None, None, None]
    answers = F.conv2d(F.pad(at(4), (2, 2, 2, 2), mode="replicate"), kernels)
    return [*colors(at), F.avg_pool2d(torch.cat([answers, -answers], 1).clamp(min=0), 4)]


def sift(at: Samples) -> list[Tensor]:
    """OpenCV's SIFT around each patch, 131 channels."""
    samples = at(4)
    points = [
        cv2.KeyPoint(4 * j + 1.5, 4 * i + 1.5, 8.0, 0.0) for i in range(14) for j in range(14)
    ]
    descriptor: Any = cv2.SIFT_create()  # type: ignore[attr-defined]
    found = [
        descriptor.compute(image, points)[1]
        for image in (255 * luminance(samples)).round().to(torch.uint8).numpy()
    ]
    grids = torch.tensor(np.array(found) / 512, dtype=torch.float32).transpose(1, 2)
    return [*colors(at), torch.unflatten(grids, 2, (14, 14))]


def roots(at: Samples) -> list[Tensor]:
    """`dense` of the square roots of the colors, which are steeper in the dark, 16 channels."""
    return edges(lambda side: at(side).sqrt())


class Descriptor(PatchEncoder):
    """An encoder of one of the descriptors, on `side` x `side` tokens."""

    name = version = "descriptor"
    views = (3, None)

    def __init__(
        self,
        describe: Callable[[Samples], list[Tensor]] = edges,
        *,
        side: int = 14,
        despeckle: bool = True,
        device: str | torch.device = "cpu",
    ) -> None:
        super().__init__(device=device)
        self._describe, self._side, self._despeckle = describe, side, despeckle
        self._channels = self._encode(torch.zeros(1, 112, 112, 3)).shape[2]

    def shape(self, height: int, width: int) -> tuple[int, int]:
        """(T, C)."""
        return self._side**2, self._channels

    def _prepare(self, batch: Float32) -> Float32:
        return np.stack([despeckled(image) for image in batch]) if self._despeckle else batch

    def _encode(self, images: Tensor) -> Tensor:
        def at(side: int) -> Tensor:
            n = side * self._side
            boxes = [cv2.resize(i, (n, n), interpolation=cv2.INTER_AREA) for i in images.numpy()]
            return torch.tensor(np.array(boxes)).permute(0, 3, 1, 2).contiguous()

        return torch.cat(self._describe(at), dim=1).flatten(2).transpose(1, 2)


VARIANTS: dict[str, Callable[..., PatchEncoder]] = {
    "dense": dense.DenseEncoder,
    "without smoothing": Descriptor,
    "without despeckling": partial(Descriptor, despeckle=False),
    "mean colors only": partial(Descriptor, colors),
    "without edges": partial(Descriptor, quarters),
    "edges times 4": partial(Descriptor, partial(edges, gain=4.0)),
    "finer edges too": partial(Descriptor, fine_edges),
    "gradients in 8 directions": partial(Descriptor, orientations),
    "Haar wavelets, 2 levels": partial(Descriptor, wavelets),
    "colors at 3 scales": partial(Descriptor, blurs),
    "histograms of 5 tones": partial(Descriptor, histograms),
    "random convolutions": partial(Descriptor, random_kernels),
    "SIFT": partial(Descriptor, sift),
    "roots of colors": partial(Descriptor, roots),
    "7 x 7 tokens": partial(Descriptor, side=7),
    "20 x 20 tokens": partial(Descriptor, side=20),
}


# -- noise -----------------------------------------------------------------------------------------


def noise(arguments: argparse.Namespace) -> None:
    """Share of noise in distances of Beads, and how well they keep the order."""
    print("| descriptor | channels | ms | noise / difference | order |\n|---|" + "---:|" * 4)
    for name, make in VARIANTS.items():
        encoder = make()
        share, kept = measured(of_encoder(encoder), arguments.size)
        cells = [encoder.shape(112, 112)[1], f"{cost(encoder):.2f}", f"{share:.3f}", f"{kept:.2f}"]
        print(f"| {name} | {' | '.join(map(str, cells))} |", flush=True)


def cost(encoder: PatchEncoder) -> float:
    """Milliseconds of CPU time for a noisy image of 112 x 112, the least of three goes."""
    images = np.random.default_rng(0).random((24, 112, 112, 3), dtype=np.float32)
    goes = []
    for _ in range(3):
        start = time.process_time()
        encoder(images)
        goes.append(time.process_time() - start)
    return 1e3 * min(goes) / len(images)


# -- what FIDE makes of them -----------------------------------------------------------------------


def fit(arguments: argparse.Namespace) -> None:
    """Runs that differ in the encoder."""
    table: dict[str, tuple[str, dict[str, Any]]] = {}
    for name, make in VARIANTS.items():
        encoders.register(f"descriptor {name}", make)
        table[name] = ("mse", {"encoder": f"descriptor {name}"})
    cells = [
        {
            "task": task,
            "target": seed,
            "configuration": configuration,
            "seed": seed,
            "size": arguments.size,
        }
        | {"budget": BUDGET}
        for seed in range(arguments.seeds)
        for task in arguments.tasks or ("voronoi", "spline", "robot")
        for configuration in arguments.configurations
    ]
    run_configurations(cells, table, arguments.out, "0/1", measure)


def print_table(arguments: argparse.Namespace) -> None:
    """Median loss at the end, and the loss on the way over that of `dense` with the same seeds.

    On the way: the geometric mean of the losses after 250, 300, ... 500 renders, then that over the
    seeds, with its standard error.
    """
    rows = read(arguments.out)
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    print(f"| descriptor | {' | '.join(f'{t} | over `dense`' for t in tasks)} |")
    print(f"|---|{'---:|' * 2 * len(tasks)}")
    for name in [name for name in VARIANTS if any(row["configuration"] == name for row in rows)]:
        cells = [cell for task in tasks for cell in compared(rows, task, name)]
        print(f"| {name} | {' | '.join(cells)} |")


def compared(rows: list[Row], task: str, name: str) -> tuple[str, str]:
    """Median loss at the end; the comparison with `dense` on the same seeds."""
    own, others = (
        {
            r["seed"]: r["best"]
            for r in rows
            if (r["task"], r["configuration"]) == (task, configuration)
        }
        for configuration in (name, "dense")
    )
    shared = sorted(set(own) & set(others))
    if not shared:
        return "", ""
    way = [np.log(own[s][4:]).mean() - np.log(others[s][4:]).mean() for s in shared]
    ratio, error = np.exp(np.mean(way)), np.std(way, ddof=1) / np.sqrt(len(way))
    median = statistics.median(own[s][-1] for s in shared)
    return f"{median:.4f}", "" if name == "dense" else f"{ratio:.2f} ± {ratio * error:.2f}"


def main() -> None:
    """Do what is asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("what", choices=("noise", "fit", "table"))
    add("tasks", nargs="*", metavar="TASK")
    add(
        "--configurations",
        nargs="+",
        default=list(VARIANTS),
        choices=list(VARIANTS),
        metavar="NAME",
    )
    add("--seeds", type=int, default=10)
    add("--size", type=int, default=112, metavar="PX")
    add("--out", type=Path, default=RESULTS, metavar="FILE")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    {"noise": noise, "fit": fit, "table": print_table}[arguments.what](arguments)


if __name__ == "__main__":
    main()
