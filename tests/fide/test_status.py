"""What is known of a run, in a sentence."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest

from fide_plugins import FIDE, Float, Space
from fide_plugins.status import Facts, status_of
from fide_plugins.types import Float32, Float64

RUN = Facts(evaluations=3000, best=0.01, improved_at=1200, horizon=500, ended=[2, 1, 1])


@pytest.mark.parametrize(
    ("facts", "code", "says"),
    [
        (replace(RUN, best=None), "waiting", "finite loss"),
        (replace(RUN, solved=True), "solved", "0.01"),
        (replace(RUN, noise=0.02), "noise", "samples per pixel"),
        (replace(RUN, noise=0.02), "noise", "larger, fainter ones may be missing"),
        (replace(RUN, improved_at=2800), "improving", "Still improving"),
        (replace(RUN, ended=[]), "stalled", "since evaluation 1,200"),
        (replace(RUN, ended=[1, 0]), "stalled", "of one search, no second one began elsewhere. Un"),
        (RUN, "unsure", "2 of 4 searches from different starting points ended at this answer"),
        (replace(RUN, ended=[5, 1]), "agreed", "5 of 6 searches from different starting points"),
        (replace(RUN, ended=[5, 1], forgotten=3), "agreed", "5 of 9 searches"),
        (replace(RUN, ended=[5, 1], forgotten=4), "unsure", "5 of 10 searches"),
        (replace(RUN, ended=[2, 0]), "unsure", "answer, too few to be sure"),
        (replace(RUN, ended=[0, 3]), "unsure", "0 of 3 searches"),
        (replace(RUN, ended=[3, 3]), "unsure", "so there may be a better one"),
        (
            replace(RUN, others=0.012, apart=0.42),
            "unsure",
            "(the best of the others has loss 0.012; parameters differ by up to 42% of their "
            "range), so there may be a better one: fit again with another seed and compare the "
            "losses, or give more renders.",
        ),
        (replace(RUN, best=-1.0), "unsure", "loss -1"),
        (
            replace(RUN, same=3000),
            "stalled",
            "All 3,000 candidates have the same image: loss 0.01",
        ),
        (replace(RUN, same=3000, clipped=100), "stalled", "Does render use its parameters"),
        (
            replace(RUN, same=3000, clipped=2900, low=0, high=255),
            "stalled",
            "values from 0 to 255. Give value_range=(low, high)",
        ),
        (replace(RUN, same=3000, solved=True), "solved", "0.01"),
    ],
)
def test_what_is_known(facts: Facts, code: str, says: str) -> None:
    status = status_of(facts)
    assert status.code == code and says in status.sentence and str(status) == status.sentence


V, U = np.mgrid[0:32, 0:32] / 31
SPACE = Space(x=Float(0, 1), y=Float(0, 1), size=Float(0.05, 0.3))


def blob(p: Mapping[str, float]) -> Float64:
    """A soft blob (32, 32) on gray."""
    squares = (U - p["x"]) ** 2 + (V - p["y"]) ** 2
    return np.asarray(0.2 + 0.6 * np.exp(-squares / (2 * p["size"] ** 2)), np.float64)


def codes(opt: FIDE, render: Callable[[Mapping[str, float]], Float64], n: int) -> list[str]:
    """Codes of the status after each of some generations, of n renders in all."""
    seen, end = [], opt.evaluations + n
    while opt.evaluations < end:
        X = opt.ask()
        opt.tell(X, [render(p) for p in SPACE.decode_many(X)])
        seen.append(opt.status.code)
    return seen


@pytest.mark.parametrize("loss", ["mse", "perceptual"])
@pytest.mark.parametrize("of_target", [0.0, 0.05])
def test_at_the_floor_of_the_noise_it_says_so_and_not_before(loss: str, of_target: float) -> None:
    """Whatever the loss is, and also where the target has as much noise."""
    rng = np.random.default_rng(0)

    def render(p: Mapping[str, float]) -> Float64:
        return np.clip(blob(p) + 0.05 * rng.standard_normal((32, 32)), 0, 1)

    truth = {"x": 0.63, "y": 0.31, "size": 0.14}
    for seed in range(3):
        target = np.clip(blob(truth) + of_target * rng.standard_normal((32, 32)), 0, 1)
        opt = FIDE(SPACE, target, loss=loss, seed=seed)
        while opt.evaluations < 2000 and opt.status.code != "noise":
            codes(opt, render, 1)
        assert opt.best is not None and opt.best.params is not None
        assert opt.status.code == "noise" and opt.evaluations > 100
        assert max(abs(opt.best.params[name] - truth[name]) for name in truth) < 0.03
        opt.retarget(blob({"x": 0.2, "y": 0.7, "size": 0.1}))
        assert opt.status.code == "waiting" and opt.state.moves.noise is None
        assert codes(opt, render, 10) == ["improving"] * 2


def test_a_loss_that_varies_at_a_wrong_answer_is_no_floor() -> None:
    """Images flicker as a whole, and most local optima of stripes are wrong."""
    space = Space(f=Float(1, 12), g=Float(1, 12), phase=Float(0, 6.2), gray=Float(0.2, 0.8))

    def stripes(p: Mapping[str, float]) -> Float64:
        wave = np.sin(2 * np.pi * (p["f"] * U + p["g"] * V) + p["phase"])
        return np.asarray(p["gray"] + 0.2 * wave, np.float64)

    for seed in range(4):
        rng = np.random.default_rng(seed)
        truth = space.decode(0.1 + 0.8 * np.random.default_rng(100 + seed).random(4))
        opt = FIDE(space, np.clip(stripes(truth), 0, 1), seed=seed)
        while opt.evaluations < 500:
            X = opt.ask()
            flicker = 0.1 * rng.standard_normal((len(X), 1, 1))
            images = np.array([stripes(p) for p in space.decode_many(X)]) + flicker
            opt.tell(X, np.clip(images, 0, 1))
            assert opt.status.code != "noise"
        assert opt.state.moves.noise is not None and opt.state.moves.noise > 0


def picture(column: int = 10) -> Float32:
    """A gray picture (512, 512, 3), 8 bits, with a nail of 3 x 3 pixels in this column.

    Its first row is black and white.
    """
    image = np.full((512, 512, 3), 120, np.float32)
    image[0, :256], image[0, 256:] = 0, 255
    image[10:13, column : column + 3] -= 25
    return image / np.float32(255)
