"""What is known of a run, in a sentence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fide_plugins import FIDE
from fide_plugins.status import Facts, status_of
from fide_plugins.types import Float32

RUN = Facts(evaluations=3000, best=0.01, improved_at=1200, horizon=500, ended=[2, 1, 1])


@pytest.mark.parametrize(
    ("facts", "code", "says"),
    [
        (replace(RUN, best=None), "waiting", "finite loss"),
        (replace(RUN, solved=True), "solved", "0.01"),
        (replace(RUN, noise=0.02), "noise", "samples per pixel"),
        (replace(RUN, improved_at=2800), "improving", "Still improving"),
        (replace(RUN, ended=[]), "stalled", "since evaluation 1,200"),
        (replace(RUN, ended=[1]), "stalled", "since evaluation 1,200"),
        (RUN, "unsure", "4 searches ended in 3 different places, 2 in the best"),
        (replace(RUN, ended=[5, 1]), "agreed", "5 of 6 searches ended in this place"),
        (replace(RUN, ended=[2]), "unsure", "2 of 2 searches ended in this place, too few"),
        (replace(RUN, ended=[3, 3]), "unsure", "2 different places"),
        (replace(RUN, noise=1e-4), "unsure", "0.01"),
        (replace(RUN, best=-1.0, noise=0.1), "unsure", "loss -1"),
    ],
)
def test_what_is_known(facts: Facts, code: str, says: str) -> None:
    status = status_of(facts)
    assert status.code == code and says in status.sentence and str(status) == status.sentence


def picture(column: int = 10) -> Float32:
    """A gray picture (512, 512, 3), 8 bits, with a nail of 3 x 3 pixels in this column."""
    image = np.full((512, 512, 3), 120, np.float32)
    image[10:13, column : column + 3] -= 25
    return image / np.float32(255)


def code_of(image: Float32, **options: object) -> str:
    """Of a run that was told this image once."""
    opt = FIDE(2, picture(), seed=0, encoder="patch", **options)  # type: ignore[arg-type]
    opt.tell(opt.ask(1), image[None])
    return opt.status.code


def test_a_small_object_in_a_large_picture_counts() -> None:
    """Its place hardly changes the mean squared error."""
    moved = picture(400)
    assert np.square(moved - picture()).mean() < (1 / 255) ** 2 / 12
    assert code_of(moved) == "improving"


def test_rounding_to_8_bits_does_not_count() -> None:
    rng = np.random.default_rng(0)
    halves = rng.uniform(-0.45, 0.45, (512, 512, 3))
    few = rng.random((512, 512, 3)) < 0.05
    assert code_of((picture() + halves / 255).astype(np.float32)) == "solved"
    assert code_of((picture() + few / 255).astype(np.float32)) == "solved"
    assert code_of((picture() + 2 * few / 255).astype(np.float32)) == "improving"


def test_pixels_that_do_not_count_may_differ() -> None:
    mask = np.ones((512, 512), np.float32)
    mask[:, 400:403] = 0
    image = picture()
    image[:, 400:403] = 0
    assert code_of(image, mask=mask) == "solved"
    image[20, 20] += 0.1
    assert code_of(image, mask=mask) == "improving"
