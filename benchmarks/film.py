"""README's film: target, CMA-ES and FIDE, each with its best image after as many renders.

    python benchmarks/film.py robot --target 1020 --budget 5000 --out docs/images/film.webp

The first frame, which is what a reader sees where films stand still, is the end.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import fide_tasks
from fide_lab import optimizers
from fide_plugins import losses

STEP = 1.06  # from one frame to the next, renders become so many times as many
PANE = 220  # pixels of a side
HEAD = 28  # pixels above a pane


def best_images(name: str, task: Any, marks: list[int], seed: int) -> list[Any]:
    """Best image (H, W, 3) of an optimizer after so many renders, each of `marks`."""
    optimizer = optimizers.make(name, task.dim, task.target, seed=seed)
    mse = losses.make("mse", task.target)
    best, image, done = np.inf, np.zeros_like(task.target), 0
    images: list[Any] = []
    while len(images) < len(marks):
        X = optimizer.ask(1)
        rendered = task.render(X)
        (loss,) = mse(rendered)
        optimizer.tell(X, rendered, [loss])
        done += 1
        if loss < best:
            best, image = loss, rendered[0].copy()
        if done == marks[len(images)]:
            images.append(image)
    print(f"{name}: best loss {best:.3g} after {done} renders", flush=True)
    return images


def frame(panes: list[tuple[str, Any]], renders: int) -> Image.Image:
    """Panes with their names, and the number of renders."""
    font = ImageFont.load_default(15)
    whole = Image.new("RGB", (PANE * len(panes), PANE + HEAD), "white")
    draw = ImageDraw.Draw(whole)
    for i, (name, image) in enumerate(panes):
        pixels = Image.fromarray((np.clip(image, 0, 1) * 255).round().astype(np.uint8))
        whole.paste(
            pixels.resize((PANE - 4, PANE - 4), Image.Resampling.BICUBIC), (i * PANE + 2, HEAD)
        )
        label = name if i == 0 else f"{name}, {renders:,} renders"
        draw.text((i * PANE + 4, 5), label, "black", font=font)
    return whole


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task")
    parser.add_argument("--target", type=int, default=1020, help="seed of the task")
    parser.add_argument("--budget", type=int, default=5000)
    parser.add_argument("--size", type=int, default=112)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("docs/images/film.webp"))
    o = parser.parse_args()
    task = fide_tasks.make(o.task, size=o.size, seed=o.target)
    marks = sorted({round(STEP**i) for i in range(1000) if STEP**i < o.budget} | {o.budget})
    cma, fide = (best_images(name, task, marks, o.seed) for name in ("cma", "fide"))
    frames = [
        frame([("Target", task.target), ("CMA-ES", c), ("FIDE", f)], n)
        for n, c, f in zip(marks, cma, fide, strict=True)
    ]
    times = [1500] + [80] * (len(frames) - 1) + [2500]  # ms
    last = frames[-1]
    last.save(
        o.out, save_all=True, append_images=frames, duration=times, loop=0, quality=75, method=6
    )


if __name__ == "__main__":
    main()
