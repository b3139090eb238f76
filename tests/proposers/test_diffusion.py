"""The published proposer: it learns, it is deterministic, and it continues bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from fide_plugins.errors import OptionError
from fide_plugins.proposers.diffusion import DiffusionProposer

Floats = NDArray[np.float64]
MEAN, STD = np.array([0.5, 0.5]), np.array([0.1, 0.2])
MIXING = torch.tensor([[1.0, 0.3], [-0.5, 1.0], [0.2, -0.7]])


def make(seed: int = 0, **options: Any) -> DiffusionProposer:
    return DiffusionProposer(2, seed=seed, **({"width": 16, "blocks": 2, "epochs": 2} | options))


def scene(n: int, seed: int = 0) -> tuple[Floats, Tensor]:
    """Parameters (n, 2) around the center, and "images" of 3 tokens that show them."""
    x = 0.5 + STD * np.random.default_rng(seed).standard_normal((n, 2))
    return x, images_of(x)


def images_of(x: Floats) -> Tensor:
    shown = torch.as_tensor((x - 0.5) / STD, dtype=torch.float32) @ MIXING.T  # (n, 3)
    return shown[:, :, None].tanh()  # (n, 3, 1)


def test_learns_to_read_the_parameters_from_the_image() -> None:
    """The loss falls far below the identity's, E[s^2], and proposals fall near the answer."""
    x, tokens = scene(200)
    proposer = make(epochs=40, batch_size=20)
    losses = proposer.update(x, tokens, None, STD)
    identity = float((STD**2).mean() / 3)  # E[t^2] = 1/3
    assert float(losses[-1]) < 0.25 * identity
    answer = np.array([0.55, 0.35])
    z = 0.5 + STD * np.random.default_rng(1).standard_normal((100, 2))
    proposed = proposer.propose(z, images_of(answer[None])[0], MEAN, STD)
    before, after = (np.linalg.norm(p - answer, axis=1).mean() for p in (z, proposed))
    assert after < 0.35 * before


def by_the_sample(proposed: Floats, z: Floats) -> bool:
    """Whether a sample itself stands where the network gave no number."""
    return bool((proposed == z).any())


@pytest.mark.parametrize("rate", [1e3, 1e300])
def test_training_that_diverges_is_undone_and_said_once(rate: float) -> None:
    x, tokens = scene(30)
    proposer = make(learning_rate=rate)
    calm = make()
    calm.update(x, tokens, None, STD)
    weights = calm.state_dict()["weights"]
    proposer.load_state_dict(calm.state_dict())
    with pytest.warns(RuntimeWarning, match="diverged with learning_rate"):
        proposer.update(x, tokens, None, STD)
    proposer.update(x, tokens, None, STD)  # with no other warning
    after = proposer.state_dict()["weights"]
    assert all(torch.equal(after[name], weights[name]) for name in weights)
    proposed = proposer.propose(x, tokens[0], MEAN, STD)
    np.testing.assert_array_equal(proposed, calm.propose(x, tokens[0], MEAN, STD))
    assert not by_the_sample(proposed, x)


def test_a_network_that_overflows_leaves_samples_as_they_are() -> None:
    x, tokens = scene(20)
    proposer = make()
    proposer.update(x, tokens, None, STD)
    state = proposer.state_dict()
    state["weights"] = {name: 1e30 * value for name, value in state["weights"].items()}
    proposer.load_state_dict(state)
    np.testing.assert_array_equal(proposer.propose(x, tokens[0], MEAN, STD), x)


def test_other_images_are_refused_before_anything_changes() -> None:
    proposer = make()
    x, tokens = scene(10)
    proposer.update(x, tokens, None, STD)
    with pytest.raises(OptionError, match=r"\(3, 1\).*got \(2, 1\)"):
        proposer.update(x, tokens[:, :2], None, STD)
    assert proposer.updates == 1


@pytest.mark.parametrize(
    "options",
    [{"epochs": 0}, {"batch_size": 0}, {"learning_rate": 0.0}, {"schedule": (0.1, 0.2)}],
)
def test_bad_options(options: dict[str, Any]) -> None:
    with pytest.raises(OptionError):
        make(**options)
