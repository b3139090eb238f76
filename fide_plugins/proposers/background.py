"""Train while the user renders.

Of a generation, the candidates that the search distribution drew need no denoiser.  `FIDE` hands
them out first, and so a proposer may learn from the last generation while they are rendered; only
the proposals wait for it.  Training is then free wherever rendering that part of a generation takes
longer.

`BackgroundProposer` makes this of any proposer that is always ready and whose proposals draw
nothing from the search's generator: it learns in a thread, and whatever else it is asked waits.
What comes out is the same, bit for bit, as if each had waited for the other.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fide_plugins.proposers.base import Proposer, ProposerDefaults
from fide_plugins.runtime.devices import on_current_stream
from fide_plugins.runtime.schema import Sides
from fide_plugins.runtime.threads import Background, user_threads
from fide_plugins.types import Float64

__all__ = ["BackgroundProposer"]


class BackgroundProposer(ProposerDefaults):
    """A proposer that learns in the background, on the device and its stream that are in use.

    What training raises is raised by whatever waits for it next: `propose`, the next `update`,
    which begins all the same, or saving.
    """

    background = True

    def __init__(self, proposer: Proposer, device: torch.device | str = "cpu") -> None:
        self._proposer, self._device = proposer, torch.device(device)
        self._training = Background()

    @property
    def ready(self) -> bool:
        """Whether it can be asked."""
        return self._proposer.ready

    @property
    def busy(self) -> bool:
        """Whether it learns right now."""
        return self._training.busy

    def update(self, x: Float64, tokens: Tensor, losses: Float64, std: Float64) -> None:
        """Begin to learn; see `Proposer`. The caller must not change the arrays any more."""
        with user_threads:
            threads, here = torch.get_num_threads(), on_current_stream(self._device)

        def train() -> None:
            torch.set_num_threads(threads)  # sums are the same in as many threads
            with here():
                self._proposer.update(x, tokens, losses, std)

        self._training.start(train, "training of the denoiser")

    def propose(
        self,
        z: Float64,
        target: Tensor,
        mean: Float64,
        std: Float64,
        rng: np.random.Generator,
    ) -> Float64:
        """Candidates, when all is learned; see `Proposer`."""
        self._training.wait()
        return self._proposer.propose(z, target, mean, std, rng)

    def forget(self) -> None:
        """Another search begins; raises nothing of training's."""
        self._training.join()
        self._proposer.forget()

    def state_dict(self) -> dict[str, Any]:
        """Everything that `update` changes, when it has."""
        self._training.wait()
        return self._proposer.state_dict()

    def load_state_dict(self, state: Mapping[str, Any], sides: Sides | None = None) -> None:
        """Put back what `state_dict` gave."""
        self._training.wait()
        self._proposer.load_state_dict(state, sides)

    def preview(self, x: Float64, tokens: Tensor, losses: Float64, std: Float64) -> Proposer:
        """The proposer as it is: training takes too long for a preview."""
        return self

    def __getstate__(self) -> dict[str, Any]:
        """For copies, which have no thread."""
        self._training.wait()
        return {"_proposer": self._proposer, "_device": self._device}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._proposer, self._device = state["_proposer"], state["_device"]
        self._training = Background()
