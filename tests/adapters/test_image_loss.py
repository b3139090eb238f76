"""A loss that carries an image."""

from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from fide_adapters.image_loss import (
    ImageLoss,
    Result,
    is_image,
    read_result,
)
from fide_plugins.errors import LossError

IMAGE = np.linspace(0, 1, 4 * 5 * 3).reshape(4, 5, 3)


def test_it_is_a_float_for_everybody_else() -> None:
    loss = ImageLoss(0.25, IMAGE)
    assert isinstance(loss, float) and loss == 0.25 and loss + 1 == 1.25 and loss < 0.3
    assert loss.image is IMAGE
    assert type(float(loss)) is float
    assert type(-loss) is float


@pytest.mark.parametrize("value", [1, np.float32(1), np.array(1.0), torch.tensor(1.0), True])
def test_kinds_of_numbers(value: float) -> None:
    assert ImageLoss(value) == 1.0


@pytest.mark.parametrize("value", ["1", None, 1j, [1.0], np.zeros(1), np.zeros((2, 2))])
def test_what_is_no_number(value: object) -> None:
    with pytest.raises(LossError, match="one real number"):
        ImageLoss(value)  # type: ignore[arg-type]


def test_it_comes_through_pickle_whole() -> None:
    copy = pickle.loads(pickle.dumps(ImageLoss(0.1, IMAGE)))
    assert type(copy) is ImageLoss and copy == 0.1
    np.testing.assert_array_equal(copy.image, IMAGE)


def test_what_objectives_give_back() -> None:
    ref, pil = "a.png", Image.new("RGB", (2, 2))
    assert read_result(0.5) == Result(0.5)
    assert read_result(ImageLoss(0.5, ref)) == Result(0.5, ref)
    assert read_result(pil) == Result(None, pil)
    assert read_result((0.5, ref)) == Result(0.5, ref)
    assert read_result((None, ref)) == Result(None, ref)
    assert read_result((0.5, None)) == Result(0.5)
    assert read_result((ImageLoss(0.5, ref), None)) == Result(0.5, ref)
    assert read_result((0.5, 0.25)) == Result((0.5, 0.25))
    assert read_result([0.5, 0.25]) == Result([0.5, 0.25])


def test_images_and_numbers() -> None:
    for image in (IMAGE, IMAGE[..., 0], torch.zeros(3, 4, 5), Image.new("L", (1, 1))):
        assert is_image(image)
    for told in ("a.png", Path("a.png"), ["a.png", IMAGE], IMAGE.tolist(), IMAGE[..., 0].tolist()):
        assert is_image(told) and read_result((0.5, told)) == Result(0.5, told)
    for number in (1.0, np.zeros(3), torch.zeros(()), torch.zeros(3), [1.0], [[1.0], 2.0], None):
        assert not is_image(number)


def test_importing_it_loads_no_framework() -> None:
    probe = """
import sys, fide_adapters.image_loss
print(*sorted({"torch", "nevergrad", "optuna", "PIL"} & set(sys.modules)))
"""
    output = subprocess.run(
        [sys.executable, "-c", probe], capture_output=True, text=True, check=True
    )
    assert output.stdout.split() == []
