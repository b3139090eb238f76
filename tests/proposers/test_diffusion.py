"""The published proposer: it learns, it is deterministic, and it continues bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from fide_plugins.denoiser import Denoise, network as network_module
from fide_plugins.denoiser.training import XLoss
from fide_plugins.errors import OptionError
from fide_plugins.proposers.diffusion import DiffusionProposer
from fide_plugins.runtime.devices import BatchSize

Floats = NDArray[np.float64]
MEAN, STD = np.array([0.5, 0.5]), np.array([0.1, 0.2])
MIXING = torch.tensor([[1.0, 0.3], [-0.5, 1.0], [0.2, -0.7]])


def make(seed: int = 0, **options: Any) -> DiffusionProposer:
    return DiffusionProposer(2, seed=seed, **({"width": 16, "blocks": 2, "epochs": 2} | options))


def scene(n: int, seed: int = 0) -> tuple[Floats, Tensor]:
    """Parameters (n, 2) around the center, and "images" of 3 tokens that show them."""
    x = 0.5 + STD * np.random.default_rng(seed).standard_normal((n, 2))
    return x, images_of(x)


def in_bfloat16() -> torch.autocast:
    return torch.autocast("cpu", torch.bfloat16)


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


@pytest.mark.parametrize("generations", [0, 1])
def test_a_state_is_loaded_where_another_device_is_the_default(generations: int) -> None:
    original, copy = make(3), make(99)
    for _ in range(generations):
        original.update(*scene(30), None, STD)
    with torch.device("meta"):  # stands for a GPU
        copy.load_state_dict(as_numpy(original.state_dict()))
    x, tokens = scene(30, seed=5)
    assert torch.equal(original.update(x, tokens, None, STD), copy.update(x, tokens, None, STD))


def as_numpy(state: dict[str, Any]) -> dict[str, Any]:
    def convert(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: convert(entry) for key, entry in value.items()}
        return value.numpy() if isinstance(value, Tensor) else value

    return {key: convert(value) for key, value in state.items()}


def test_weights_and_moments_are_carried_on() -> None:
    proposer = make(epochs=3, batch_size=10)
    x, tokens = scene(20)
    first = proposer.update(x, tokens, None, STD)
    second = proposer.update(x, tokens, None, STD)
    assert float(second[0]) < float(first[0])
    steps = {float(entry["step"]) for entry in proposer.state_dict()["adam"].values()}
    assert steps == {2 * 3 * 2.0}  # updates x epochs x minibatches


def test_global_random_state_is_neither_read_nor_changed() -> None:
    x, tokens = scene(20)
    out = []
    for seed in (0, 1):
        torch.manual_seed(seed)
        before = torch.get_rng_state()
        proposer = make()
        proposer.update(x, tokens, None, STD)
        out.append(proposer.propose(x, tokens[0], MEAN, STD))
        assert torch.equal(before, torch.get_rng_state())
    assert np.array_equal(out[0], out[1])


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


class Interrupting:
    """The published objective, until it has been asked so often."""

    def __init__(self, error: BaseException, after: int) -> None:
        self.error, self.left = error, after

    def __call__(
        self, denoise: Denoise, x: Tensor, std: Tensor, generator: torch.Generator
    ) -> Tensor:
        self.left -= 1
        if self.left < 0:
            raise self.error
        return XLoss()(denoise, x, std, generator)


def state_as_bytes(proposer: DiffusionProposer) -> dict[str, Any]:
    def flat(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: flat(entry) for key, entry in value.items()}
        return value.numpy().tobytes() if isinstance(value, Tensor) else value

    return {key: flat(value) for key, value in proposer.state_dict().items()}


@pytest.mark.parametrize("generations", [0, 1])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), MemoryError("too large")])
def test_training_that_raises_is_undone(generations: int, error: BaseException) -> None:
    """Weights, moments and noise: it goes on, bit for bit, as if it had not been tried."""
    proposer, other = make(batch_size=1), make(batch_size=1)
    x, tokens = scene(8)
    for each in (proposer, other):
        each._parts(3, 1)
        for _ in range(generations):
            each.update(x, tokens, None, STD)
    proposer.objective = Interrupting(error, after=7)
    with pytest.raises(type(error)):
        proposer.update(x, tokens, None, STD)
    assert state_as_bytes(proposer) == state_as_bytes(other)
    proposer.objective = XLoss()
    for each in (proposer, other):
        each.update(x, tokens, None, STD)
    assert state_as_bytes(proposer) == state_as_bytes(other)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode, in_bfloat16])
def test_the_caller_s_mode_does_not_matter(mode: Any) -> None:
    """Another thread would know nothing of it, and the run must be the same."""
    x, tokens = scene(20)
    plain, within = make(), make()
    first = plain.propose(x, tokens[0], MEAN, STD)
    plain.update(x, tokens, None, STD)
    plain.load_state_dict(plain.state_dict())
    plain.update(x, tokens, None, STD)
    with mode():
        seen = tokens.clone()  # in inference mode, a tensor that no gradient may pass
        np.testing.assert_array_equal(within.propose(x, seen[0], MEAN, STD), first)
        within.update(x, seen, None, STD)
        within.load_state_dict(within.state_dict())
        within.update(x, seen, None, STD)
        proposed = within.propose(x, seen[0], MEAN, STD)
    assert state_as_bytes(within) == state_as_bytes(plain)
    np.testing.assert_array_equal(proposed, plain.propose(x, tokens[0], MEAN, STD))


def test_images_may_lie_elsewhere_and_in_double_precision() -> None:
    """They go to the device a minibatch at a time."""
    x, tokens = scene(30)
    plain, other = make(batch_size=8), make(batch_size=8)
    plain.update(x, tokens, None, STD)
    other.update(x, tokens.double(), None, STD)
    assert state_as_bytes(other) == state_as_bytes(plain)


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


def test_out_of_memory_gives_smaller_batches_said_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A device with room for three: nobody is left out, of training or of proposals."""
    proposer, (x, tokens) = make(batch_size=16), scene(40)
    network, _ = proposer._parts(3, 1)
    trained: list[int] = []
    forward = type(network).forward

    def tight(self: Any, z: Tensor, s: Tensor, context: Any) -> Tensor:
        if len(z) > 3:
            raise torch.OutOfMemoryError("CUDA out of memory")
        trained.append(len(z))
        return forward(self, z, s, context)

    monkeypatch.setattr(type(network), "forward", tight)
    with pytest.warns(RuntimeWarning, match="too small.*from now on 8") as warned:
        history = proposer.update(x, tokens, None, STD)
    assert len(warned) == 1 and sum(trained) == 2 * 40 and bool(history.isfinite().all())
    trained.clear()
    proposer.update(x, tokens, None, STD)
    assert sum(trained) == 2 * 40 and set(trained) == {2}
    with pytest.warns(RuntimeWarning, match="proposals") as warned:
        proposed = proposer.propose(x, tokens[0], MEAN, STD)
    assert len(warned) == 1
    monkeypatch.undo()
    np.testing.assert_allclose(proposed, proposer.propose(x, tokens[0], MEAN, STD), atol=1e-5)
    twin = make(batch_size=16)
    twin.load_state_dict(as_numpy(proposer.state_dict()))
    for each in (proposer, twin):  # the twin has not seen that there is so little room
        each.update(x, tokens, None, STD)
    assert state_as_bytes(twin) == state_as_bytes(proposer)


def test_no_room_for_a_single_one_is_an_error_that_says_what_to_do() -> None:
    def refuse(piece: slice) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    with pytest.warns(RuntimeWarning), pytest.raises(torch.OutOfMemoryError) as caught:
        BatchSize(4, "things").each(refuse, 4)
    assert "device='cpu'" in caught.value.__notes__[0]


def test_bfloat16_learns_the_same_with_weights_in_float32(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(network_module, "has_bfloat16", lambda device: True)
    x, tokens = scene(100)
    proposals = []
    for kind in ("float32", "bfloat16"):
        proposer = make(precision=kind, epochs=10, batch_size=20)
        proposer.update(x, tokens, None, STD)
        proposals.append(proposer.propose(x, tokens[0], MEAN, STD))
        weights = proposer.state_dict()["weights"].values()
        assert {weight.dtype for weight in weights} == {torch.float32}
    off = np.abs(proposals[0] - proposals[1]).max()
    assert 0 < off < 0.3 * STD.max()


def test_bfloat16_where_there_is_none_is_float32_with_a_warning(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(network_module, "has_bfloat16", lambda device: False)
    with pytest.warns(RuntimeWarning, match="float32 is used instead"):
        proposer = make(precision="bfloat16")
    assert proposer.precision == "float32"
    with pytest.raises(OptionError, match="float32, bfloat16"):
        make(precision="float8")


def test_fewer_tokens_than_parameters() -> None:
    """They learn, and the cost of a block no longer grows with the parameters."""
    rng = np.random.default_rng(0)
    x = 0.5 + 0.1 * rng.standard_normal((60, 12))
    tokens = torch.as_tensor(x[:, :, None], dtype=torch.float32)  # (n, 12, 1)
    work = {}
    for n in (None, 12, 4):
        proposer = DiffusionProposer(
            12, epochs=4, batch_size=20, width=16, blocks=2, parameter_tokens=n
        )
        with FlopCounterMode(display=False) as counter:
            losses = proposer.update(x, tokens, None, np.full(12, 0.1))
        work[n] = counter.get_total_flops()
        assert float(losses[-1]) < 0.5 * float(losses[0])
    assert work[None] == work[12] > 1.8 * work[4]
