"""Real photographs: a chessboard thirteen times, and a painted wall.

    python benchmarks/photographs.py learn boards.fide    # 60,000 renders, of no photograph
    python benchmarks/photographs.py learned guess plain wall --model boards.fide
    python benchmarks/photographs.py opencv               # what OpenCV's own functions find
    python benchmarks/photographs.py table --out benchmarks/results/photographs.jsonl
    python benchmarks/photographs.py picture docs/images/boards.jpg --out ...

Boards: pose, focal length and distortion by rendering the board.  learned: `photo=True` with the
model, 1,000 renders; guess: `photo=True` from a guess that is 20 pixels off, 400 renders; plain:
the same without `photo`.  The error is the mean distance of 54 corners from those that OpenCV
detects, in pixels of a photograph of 640 x 480.  wall: a homography, by warping another photograph,
`photo=True`, 3,000 renders, ten seeds; the error is that of its corners, in pixels of 160.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rows import Row, append, read, rows_of

from fide_lab.suite import foreign, renderers
from fide_plugins import Float, Space, fit, learn

RENDERS = 60_000
BUDGETS = {"learned": 1000, "guess": 400, "plain": 400, "wall": 3000}
NUMBERS = {"learned": 13, "guess": 13, "plain": 13, "wall": 10}  # photographs, or seeds
MARKS = 150, 250, 400, 1000, 3000
OFF, STD = 20.0, 0.03
POSE = "rx", "ry", "rz", "cx", "cy", "dist", "f", "k1"
SHOWN = 0, 1, 5, 7  # photographs of the picture
RANGES = {name: at for name, at in foreign.BOARD.items() if name != "bg"}
SPACE = Space(**{name: Float(*at, periodic=name == "rz") for name, at in RANGES.items()})
PLAIN = Space(**{name: Float(*at, periodic=name == "rz") for name, at in foreign.BOARD.items()})


def draw(p: Mapping[str, float], width: int = 160) -> Any:
    """The board, and what it covers."""
    return renderers.board({"bg": 0.4, **p}, width)


def small(p: Mapping[str, float]) -> Any:
    """The board for learning, 80 x 60."""
    return draw(p, 80)


def guess(problem: foreign.Problem, space: Space, number: int) -> NDArray[np.float64]:
    """A point that is 20 pixels off, in a random direction."""
    rng = np.random.default_rng(100 + number)
    params = PLAIN.decode(problem.truth)
    truth = space.encode({name: params[name] for name in space.parameters})
    direction = rng.standard_normal(space.dim)
    near, far = 0.0, 0.3

    def at(share: float) -> NDArray[np.float64]:
        return np.clip(truth + share * direction, 0, 1)

    for _ in range(40):
        middle = (near + far) / 2
        off = problem.error(PLAIN.encode({"bg": 0.4, **space.decode(at(middle))}))
        near, far = (middle, far) if off < OFF else (near, middle)
    return at(near)


def run(arm: str, number: int, model: str | None) -> Row:
    """One photograph: errors after some numbers of renders, and what is said at the end."""
    problem = foreign.make("board", number)
    space = PLAIN if arm == "plain" else SPACE
    errors: dict[str, float] = {}

    def wrong(params: Any) -> float:
        return round(problem.error(PLAIN.encode({"bg": 0.4, **params})), 2)

    def note(event: Any) -> None:
        if event.evaluation + 1 in MARKS:
            errors[str(event.evaluation + 1)] = wrong(event.optimizer.best.params)

    options: dict[str, Any] = {"learned": model, "photo": True}
    if arm != "learned":
        options = {"x0": guess(problem, space, number), "sigma0": STD, "photo": arm == "guess"}
    result: Any = fit(
        (lambda p: draw(p)[0]) if arm == "plain" else draw, problem.target, space,
        budget=BUDGETS[arm], workers=0, seed=0, callbacks=[note], until="budget", **options,
    )  # fmt: skip
    found = {name: round(value, 4) for name, value in result.params.items()}
    end = {"error": wrong(result.params), "status": result.status.code, "params": found}
    off = deviations(problem, space, result.best)
    return {"arm": arm, "number": number, "errors": errors, **end, "deviations": off}


def deviations(problem: foreign.Problem, space: Space, best: Any) -> dict[str, float]:
    """Errors of pose, focal length and distortion, by OpenCV's calibration, over `best.std`."""
    if best.std is None:
        return {}
    truth = PLAIN.decode(problem.truth)
    off = space.encode({name: truth[name] for name in space.parameters}) - best.x
    turn = list(space.parameters).index("rz")
    off[turn] = (off[turn] + 0.25) % 0.5 - 0.25  # half a turn looks the same
    names = zip(space.parameters, off / np.maximum(best.std, 1e-9), strict=True)
    return {name: round(float(value), 2) for name, value in names if name in POSE}


def run_wall(seed: int) -> Row:
    """The wall, for a seed."""
    problem = foreign.make("wall", 0)
    errors: dict[str, float] = {}

    def note(event: Any) -> None:
        if event.evaluation + 1 in MARKS:
            errors[str(event.evaluation + 1)] = round(problem.error(event.optimizer.best.x), 2)

    result: Any = fit(
        problem.draw, problem.target, problem.dim, budget=BUDGETS["wall"], workers=0, seed=seed,
        photo=True, callbacks=[note], until="budget",
    )  # fmt: skip
    end = {"error": round(problem.error(result.best.x), 2), "status": result.status.code}
    return {"arm": "wall", "number": seed, "errors": errors, **end}


def opencv() -> None:
    """Print errors of OpenCV's corners of the boards, and of its homography of the wall."""
    pictures: Any = foreign._photograph
    for number, board in enumerate(foreign._boards()):
        photograph = pictures("boards")[120 * number : 120 * (number + 1)]
        _, found = cv2.findChessboardCornersSB(photograph, (9, 6))
        corners = (found.reshape(54, 2) + 0.5) * 4 - 0.5  # pixels of 640
        true = np.array(board["corners"])
        off = [np.linalg.norm(one - true, axis=1).mean() for one in (corners, corners[::-1])]
        print(f"board {number}: {min(off):.2f}")
    features: Any = cv2  # whose stubs do not know SIFT
    sift = features.SIFT_create(contrastThreshold=0.02)
    grays = [cv2.cvtColor(pictures(name), cv2.COLOR_RGB2GRAY) for name in ("graf1", "graf3")]
    (points, first), (others, second) = (sift.detectAndCompute(gray, None) for gray in grays)
    pairs = [
        a for a, b in cv2.BFMatcher().knnMatch(first, second, k=2) if a.distance < 0.8 * b.distance
    ]
    here = np.array([points[pair.queryIdx].pt for pair in pairs])
    there = np.array([others[pair.trainIdx].pt for pair in pairs])
    H, _ = cv2.findHomography(here, there, cv2.RANSAC, 2.0)
    height, width = grays[0].shape
    box = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float64)
    moved = cv2.perspectiveTransform(box[None], H)[0] - box
    x = moved / (1.1 * np.array([width, height])) + 0.5  # as the problem has it
    print(f"wall: {foreign.make('wall', 0).error(x.ravel()):.2f}")


def picture(rows: list[Row], path: Path) -> None:
    """Photographs, and below them what was found with the model, drawn over them."""
    columns = []
    for row in (row for row in rows if row["arm"] == "learned" and row["number"] in SHOWN):
        photograph: NDArray[Any] = foreign.make("board", row["number"]).target[..., 0]
        image, cover = draw(row["params"], 320)
        photograph = cv2.resize(photograph, (320, 240), interpolation=cv2.INTER_CUBIC)
        columns.append(np.vstack([photograph, cover * image + (1 - cover) * photograph]))
    gray = np.clip(np.hstack(columns), 0, 1)
    Image.fromarray((255 * gray).round().astype(np.uint8)).save(path, quality=80)


def table(rows: list[Row]) -> str:
    """Within 2 pixels, and the errors, by arm."""
    lines = ["| | " + " | ".join(f"within 2 at {n}" for n in MARKS) + " | errors at the end |"]
    lines.append("|---|" + "---|" * (len(MARKS) + 1))
    for arm, budget in BUDGETS.items():
        own = sorted((row for row in rows if row["arm"] == arm), key=lambda row: row["number"])
        cells = []
        for mark in MARKS:
            there = [row["errors"][str(mark)] for row in own if str(mark) in row["errors"]]
            found = sum(error <= 2 for error in there)
            cells.append(f"{found} of {len(there)}" if mark <= budget else "")
        ends = ", ".join(f"{row['error']:.1f}" for row in own)
        lines.append(f"| {arm} | {' | '.join(cells)} | {ends} |")
    for arm in BUDGETS:
        off = [
            abs(value)
            for row in rows
            if row["arm"] == arm and row["error"] <= 2
            for value in row.get("deviations", {}).values()
        ]
        if off:
            shares = [f"{np.mean(np.less_equal(off, z)):.0%} within {z}" for z in (1, 1.96)]
            lines.append(f"{arm}: of {len(off)} numbers {', '.join(shares)} standard deviations")
    return "\n".join(lines)


def main() -> None:
    """Learn, run what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "what",
        nargs="+",
        help="learn FILE, learned, guess, plain, wall, opencv, table, picture FILE",
    )
    parser.add_argument("--model")
    parser.add_argument("--out", type=Path, default=Path("runs/photographs.jsonl"))
    arguments = parser.parse_args()
    if arguments.what[0] == "learn":
        model = learn(
            small, SPACE, renders=RENDERS, size=80, out=arguments.what[1],
            backgrounds="generated", emulator=False, seed=0,
        )  # fmt: skip
        print(model.report)
        return
    for arm in arguments.what:
        if arm == "opencv":
            opencv()
            return
        if arm == "table":
            print(table(read(arguments.out)))
            return
        if arm == "picture":
            picture(read(arguments.out), Path(arguments.what[1]))
            return
        there = {(row["arm"], row["number"]) for row in rows_of(arguments.out)}
        for number in range(NUMBERS[arm]):
            if (arm, number) not in there:
                row = run_wall(number) if arm == "wall" else run(arm, number, arguments.model)
                append(arguments.out, row)
                print(row, flush=True)


if __name__ == "__main__":
    main()
