"""Frames of a video, each found from those before it by `FIDE.retarget`, against fresh searches.

    python benchmarks/retarget.py run voronoi --frames 60
    MUJOCO_GL=egl python benchmarks/retarget.py run robot --frames 60
    python benchmarks/retarget.py table

Every parameter moves along a sine of its own, slowly.  For every tenth frame a fresh search renders
until its loss is the one that counts as solved (in the suite image-fitting-v1), at most `--fresh`
images (2,000).  The median of its losses, or the one that counts as solved if that is higher, is
the goal: by `retarget` each frame is rendered until it has that, at most `--most` times.  Every
frame is a line of the file `--out`, beside which the optimizer is saved after each, under a name of
its own for all options of the video: what is there already is not done again.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from rows import Row, append, read, rows_of

import fide_tasks
from fide_lab import suite
from fide_plugins import FIDE
from fide_plugins.types import Float32, Float64

RESULTS = Path(__file__).parent / "results" / "retarget.jsonl"
AMPLITUDE = 0.1  # of the box
PERIODS = (40, 120)  # frames
EVERY = 10  # frames, of which a fresh search is made
BATCH = 5  # candidates asked at once
CELL = ("task", "size", "seed", "frames", "fresh", "preset", "proposer")  # of one video
USUAL: Row = {"frames": 60, "fresh": 2000, "preset": "balanced"}  # not named in the table


def frames_of(task: fide_tasks.Task, n: int, seed: int) -> Float32:
    """Images (n, H, W, 3) of a scene in which every parameter swings about the task's answer."""
    assert task.x_star is not None
    rng = np.random.default_rng(seed)
    period, phase = rng.uniform(*PERIODS, task.dim), rng.uniform(0, 2 * np.pi, task.dim)
    swing = np.sin(2 * np.pi * np.arange(n)[:, None] / period + phase)  # (n, d)
    center: Float64 = np.clip(task.x_star, AMPLITUDE, 1 - AMPLITUDE)
    return task.render(center + AMPLITUDE * swing)


def search(opt: FIDE, task: fide_tasks.Task, most: int, goal: float = 0.0) -> tuple[int, float]:
    """Renders until the loss is at most `goal`, at most `most`, and the loss."""
    before = opt.evaluations
    while opt.evaluations - before < most:
        X = opt.ask(min(BATCH, most - opt.evaluations + before))
        opt.tell(X, task.render(X))
        if opt.best is not None and opt.best.loss <= goal:
            break
    assert opt.best is not None
    return opt.evaluations - before, opt.best.loss


def run(arguments: argparse.Namespace) -> None:
    """All frames of one video."""
    task = fide_tasks.make(arguments.task, size=arguments.size, seed=arguments.seed)
    solved = suite.read("image-fitting-v1").scenes[arguments.task].solved
    frames = frames_of(task, arguments.frames, arguments.seed)
    cell = {name: getattr(arguments, name) for name in CELL}
    known = of_video(arguments.out, cell, "fresh")
    options = {"preset": arguments.preset, "seed": arguments.seed, "proposer": arguments.proposer}
    for t in range(0, arguments.frames, EVERY):
        if t not in known:
            n, loss = search(FIDE(task.dim, frames[t], **options), task, arguments.fresh, solved)
            known[t] = {"renders": n, "loss": loss}
            append(arguments.out, {**cell, "kind": "fresh", "frame": t, **known[t]})
    goal = max(solved, float(np.median([row["loss"] for row in known.values()])))
    there = of_video(arguments.out, cell, "retarget")
    saved = arguments.out.with_suffix(f".{digest(cell)}.checkpoint")
    if len(there) == arguments.frames:
        saved.unlink(missing_ok=True)  # of a call that was killed at its end
        return
    if not saved.exists():  # then a video begins again; of the same frame the last line counts
        there = {}
    opt = FIDE.load(saved) if there else FIDE(task.dim, frames[0], **options)
    for t in range(frames_in(opt, there), arguments.frames):
        if t:
            opt.retarget(frames[t])
        n, loss = search(opt, task, arguments.most if t else 10 * arguments.fresh, goal)
        print(f"frame {t}: {n} renders, loss {loss:.3g}, goal {goal:.3g}", flush=True)
        found = {"kind": "retarget", "frame": t, "renders": n, "loss": loss, "goal": goal}
        if t not in there:  # or the call was killed before the optimizer was saved
            append(arguments.out, {**cell, **found})
        opt.save(saved)
    saved.unlink(missing_ok=True)


def of_video(path: Path, cell: Row, kind: str) -> dict[int, Row]:
    """Rows of the file of that kind that belong to one video, by frame."""
    whole = {**cell, "kind": kind}
    return {
        row["frame"]: row
        for row in rows_of(path)
        if all(row[name] == value for name, value in whole.items())
    }


def digest(cell: Row) -> str:
    """Of all that defines a video."""
    return hashlib.sha256(json.dumps(cell, sort_keys=True).encode()).hexdigest()[:12]


def frames_in(opt: FIDE, there: dict[int, Row]) -> int:
    """How many of the first frames the optimizer has searched; there: rows of the video."""
    rendered = np.cumsum([there[t]["renders"] for t in sorted(there)])
    return int(np.searchsorted(rendered, opt.evaluations, side="right"))


def table(rows: list[Row]) -> str:
    """Of all videos, in Markdown."""
    lines = [
        "| scene | frames | goal: loss of a fresh search | its renders, mean | renders a frame: "
        "median, mean, 90 % | means, ratio | reached it |",
        "|---|---:|---:|---:|---|---:|---:|",
    ]
    videos: dict[tuple[Any, ...], dict[int, Row]] = {}
    fresh: dict[tuple[Any, ...], dict[int, int]] = {}
    for row in rows:
        key = tuple(row[name] for name in CELL)
        if row["kind"] == "retarget":
            videos.setdefault(key, {})[row["frame"]] = row
        else:
            fresh.setdefault(key, {})[row["frame"]] = row["renders"]
    for key, found in sorted(videos.items()):
        cell = dict(zip(CELL, key, strict=True))
        others = [f"{name} {cell[name]}" for name in USUAL if cell[name] != USUAL[name]]
        scene = f"{cell['task']}, {cell['size']} px, seed {cell['seed']}, {cell['proposer']}"
        alone = float(np.mean(list(fresh[key].values())))
        later = [row for frame, row in found.items() if frame]
        renders = [row["renders"] for row in later]
        reached = sum(row["loss"] <= row["goal"] for row in later)
        spread = (
            f"{np.median(renders):.0f}, {np.mean(renders):.0f}, {np.quantile(renders, 0.9):.0f}"
        )
        lines.append(
            f"| {', '.join([scene, *others])} | {len(found)} | {found[0]['goal']:.2g} "
            f"| {alone:,.0f} | {spread} | {np.mean(renders) / alone:.2f} "
            f"| {reached} of {len(later)} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Measure, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("what", choices=("run", "table"))
    parser.add_argument("task", nargs="?", default="voronoi")
    parser.add_argument("--frames", type=int, default=USUAL["frames"])
    parser.add_argument("--size", type=int, default=112)
    parser.add_argument("--seed", type=int, default=0)
    fresh = {"default": USUAL["fresh"], "help": "renders of a fresh search"}
    parser.add_argument("--fresh", type=int, **fresh)
    parser.add_argument("--most", type=int, default=1000, help="renders of a frame, at most")
    parser.add_argument("--preset", default=USUAL["preset"])
    parser.add_argument("--proposer", default="linear")
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    if arguments.what == "table":
        print(table(read(arguments.out)))
    else:
        run(arguments)


if __name__ == "__main__":
    main()
