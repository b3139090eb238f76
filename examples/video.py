"""A video: each frame is found from the one before it, and from all that was rendered so far.

    python examples/video.py

Six colored cells drift. The first frame is a search from nothing; `retarget` finds the others in a
small part of the renders.
"""

from __future__ import annotations

import numpy as np

import fide_tasks
from fide_plugins import FIDE

FRAMES = 10
GOAL = 1e-3  # mean squared error
MOST = 3000  # renders of a frame


def main() -> None:
    """Find the parameters of all frames."""
    task = fide_tasks.make("voronoi", cells=6, size=64, seed=1)
    assert task.x_star is not None
    start = np.clip(task.x_star, 0.1, 0.9)
    drift = np.random.default_rng(0).uniform(-0.01, 0.01, task.dim)
    video = task.render(start + drift * np.arange(FRAMES)[:, None])

    opt = FIDE(task.dim, video[0], seed=0)
    for number, frame in enumerate(video):
        if number:
            opt.retarget(frame)
        before = opt.evaluations
        while opt.evaluations < before + MOST and (opt.best is None or opt.best.loss > GOAL):
            X = opt.ask(5)
            opt.tell(X, task.render(X))
        assert opt.best is not None
        renders = opt.evaluations - before
        print(f"frame {number}: {renders:5} renders, loss {opt.best.loss:.2g}")


if __name__ == "__main__":
    main()
