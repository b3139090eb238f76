"""How much of what a model has learned is left in pictures that are not renders.

    python benchmarks/robustness.py robot --renders 5000 --passes 10
    python benchmarks/robustness.py table

One set of renders of 64 pixels, one network, three ways to change the images while it learns: none;
exposure, noise and sharpness, as it was at first; all of `learning.augmentation`.
The passes are the same.  The models are judged on renders that none has seen, as they are and
changed: by other code, and mostly by more than in training.

*nats*: mean log-density of the truth; the prior has 0.  *near*: share of 100 pictures with one of
64 hypotheses within 0.1 of the unit cube, in the parameters that images show.
Every model and kind of picture is one line of benchmarks/results/robustness.jsonl.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
import torch
from rows import Row, append, read, report, rows_of
from torch import Tensor
from torch.nn import functional as F

import fide_tasks
from fide_plugins.learning import training as one_training
from fide_plugins.learning.augmentation import augmented
from fide_plugins.learning.networks import Network, as_input
from fide_plugins.learning.training import Training

RESULTS = Path(__file__).parent / "results" / "robustness.jsonl"
SIZE = 64
HELD_OUT, NEAR_OF = 500, 100  # pictures for nats, and for hypotheses
SEEN = {"robot": [0, 1, 3]}  # what images show of a task, where it is not everything


# -- while learning --------------------------------------------------------------------------------


def before(images: Tensor, generator: torch.Generator) -> Tensor:
    """Exposure, noise and sharpness, each of half of the images."""
    images = images.clone()

    def half(scale: float) -> tuple[Tensor, Tensor]:
        which = torch.randperm(len(images), generator=generator)[: len(images) // 2]
        return which, scale * torch.rand(len(which), 1, 1, 1, generator=generator)

    which, fraction = half(0.5)
    blurred = F.avg_pool2d(images[which], 3, 1, 1, count_include_pad=False)
    images[which] = torch.lerp(images[which], blurred, fraction)
    which, change = half(0.1)
    images[which] *= 1 + change - 0.05
    which, deviation = half(0.02)
    few = torch.randn(16, *images.shape[1:], generator=generator)
    drawn = torch.randint(0, 32, which.shape, generator=generator)
    images[which] += deviation * torch.cat([few, -few])[drawn]
    return images.clamp_(0.0, 1.0)


CHANGES: dict[str, Callable[[Tensor, torch.Generator], Tensor]] = {
    "none": lambda images, generator: images,
    "exposure, noise, sharpness": before,
    "all": augmented,
}


# -- pictures --------------------------------------------------------------------------------------

Picture = Callable[[Any, np.random.Generator], Any]  # (H, W, 3) in [0, 1] -> any floats


def shifted(image: Any, pixels: float, rng: np.random.Generator) -> Any:
    """By at most so many pixels along each axis."""
    matrix = np.hstack([np.eye(2), rng.uniform(-pixels, pixels, (2, 1))])
    return cv2.warpAffine(image, matrix, image.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)


def occluded(image: Any, side: float, rng: np.random.Generator) -> Any:
    """With a square of one color, of that side relative to the image's."""
    image, n = image.copy(), round(side * len(image))
    top, left = rng.integers(0, len(image) - n, 2)
    image[top : top + n, left : left + n] = rng.random(3)
    return image


def photograph(image: Any, rng: np.random.Generator) -> Any:
    """A little of everything."""
    image = shifted(occluded(image, 0.15, rng), 0.5, rng)
    image = cv2.GaussianBlur(image, (0, 0), 0.7)
    image = image * rng.uniform(0.93, 1.07) * rng.uniform(0.96, 1.04, 3)
    return image + 0.02 * rng.standard_normal(image.shape)


PICTURES: dict[str, Picture] = {
    "as rendered": lambda image, rng: image,
    "blurred, 1 px": lambda image, rng: cv2.GaussianBlur(image, (0, 0), 1.0),
    "noise, 0.04": lambda image, rng: image + 0.04 * rng.standard_normal(image.shape),
    "exposure, 15 %": lambda image, rng: image * rng.choice([0.85, 1.15]),
    "color, 10 %": lambda image, rng: image * rng.uniform(0.9, 1.1, 3),
    "shifted, 1 px": lambda image, rng: shifted(image, 1.0, rng),
    "a square of a fifth of the side in front": lambda image, rng: occluded(image, 0.2, rng),
    "all, smaller": photograph,
}


def pictures(kind: str, images: Any) -> Any:
    """Renders (n, H, W, 3) uint8, changed, the same for every model."""
    rng = np.random.default_rng(17)
    changed = [PICTURES[kind](image.astype(np.float32) / 255, rng) for image in images]
    return np.rint(255 * np.clip(changed, 0, 1)).astype(np.uint8)


# -- runs ------------------------------------------------------------------------------------------


def rendered(task: Any, n: int, seed: int) -> tuple[Any, Any]:
    """Points (n, d) and their images (n, H, W, 3) uint8."""
    x = np.random.default_rng(seed).random((n, task.dim))
    images = [task.render(some, seed=seed) for some in np.array_split(x, max(1, n // 100))]
    return x, np.rint(255 * np.concatenate(images)).astype(np.uint8)


def measure(name: str, renders: int, passes: int, seed: int, out: Path) -> None:
    """Train the three models of a task, and judge each on all kinds of pictures."""
    task = fide_tasks.make(name, size=SIZE, seed=0)
    x, images = rendered(task, renders, 2 * seed)
    truth, clean = rendered(task, HELD_OUT, 2 * seed + 1)
    done = {(r["task"], r["renders"], r["passes"], r["seed"], r["learned"]) for r in rows_of(out)}
    seen = SEEN.get(name, list(range(task.dim)))
    for learned, change in CHANGES.items():
        if (name, renders, passes, seed, learned) in done:
            continue
        network = Network((SIZE, SIZE), [False] * task.dim, seed=seed)
        setattr(one_training, "augmented", partial(_changed, change))  # noqa: B010
        start = time.process_time()
        Training(network, x, images, passes, seed=seed).run()
        seconds = time.process_time() - start
        rows = [
            {
                "task": name,
                "renders": renders,
                "passes": passes,
                "seed": seed,
                "learned": learned,
                "pictures": kind,
                **judged(network, truth, pictures(kind, clean), seen),
                "seconds": round(seconds, 1),
            }
            for kind in PICTURES
        ]
        append(out, *rows)  # at once, so that a model is either judged or not
        for row in rows:
            report(row)


def _changed(change: Callable[..., Any], images: Any, generator: Any, augment: str) -> Any:
    """As `augmentation.augmented`, with one change of ours."""
    return change(images, generator)


@torch.no_grad()
def judged(network: Network, truth: Any, images: Any, seen: list[int]) -> dict[str, float]:
    """Nats of the truth (n, d) given images (n, H, W, 3), and how often a hypothesis is near."""
    shown, u = as_input(images), torch.from_numpy(truth.astype(np.float32))
    nats = [
        network.log_prob(*some)
        for some in zip(torch.split(shown, 100), torch.split(u, 100), strict=True)
    ]
    generator = torch.Generator().manual_seed(0)
    near = [
        (network.sample(image[None], 64, generator) - x)[:, seen].abs().amax(1).min() <= 0.1
        for image, x in zip(shown[:NEAR_OF], u, strict=False)
    ]
    return {"nats": round(float(torch.cat(nats).mean()), 3), "near": round(float(np.mean(near)), 3)}


def table(rows: list[Row]) -> str:
    """Nats and share near the truth, of each kind of picture and model, means over seeds."""
    lines = []
    for task, renders, passes in dict.fromkeys(
        (r["task"], r["renders"], r["passes"]) for r in rows
    ):
        mine = [
            r for r in rows if (r["task"], r["renders"], r["passes"]) == (task, renders, passes)
        ]
        seeds = sorted({r["seed"] for r in mine})
        lines += [
            f"{task}, {renders:,} renders, {passes} passes; seeds {', '.join(map(str, seeds))}",
            "",
            f"| pictures | {' | '.join(f'{c}: nats | near' for c in CHANGES)} |",
            "|---|" + "---:|" * (2 * len(CHANGES)),
        ]
        for kind in PICTURES:
            cells = []
            for learned in CHANGES:
                of = [r for r in mine if (r["learned"], r["pictures"]) == (learned, kind)]
                cells += [f"{np.mean([r[what] for r in of]):.2f}" for what in ("nats", "near")]
            lines.append(f"| {kind} | {' | '.join(cells)} |")
        times = [
            np.mean([r["seconds"] for r in mine if r["learned"] == learned]) for learned in CHANGES
        ]
        lines += [f"| CPU seconds | {' | '.join(f'{t:.0f} |' for t in times)} |", ""]
    return "\n".join(lines)


def main() -> None:
    """Do what is asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("task", help="a task, or 'table'")
    add("--renders", type=int, default=5000)
    add("--passes", type=int, default=8)
    add("--seeds", type=int, default=1)
    add("--out", type=Path, default=RESULTS, metavar="FILE")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.task == "table":
        print(table(read(arguments.out)))
        return
    for seed in range(arguments.seeds):
        measure(arguments.task, arguments.renders, arguments.passes, seed, arguments.out)


if __name__ == "__main__":
    main()
