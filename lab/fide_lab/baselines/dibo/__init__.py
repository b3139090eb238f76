"""DiBO (Yun et al. 2025): posterior inference with diffusion models, in rounds.

Every round fits new networks to the best points so far (the buffer), in double precision:

1. x and y = -loss are standardized over the buffer; training points are drawn from it with weights
   exp(y), and shifted by N(0, 0.001^2).
2. Proxy: an ensemble of five perceptrons predicts y; the reward r is their mean + gamma * standard
   deviation.
3. Prior: a diffusion model of x.
4. Posterior: the prior's noise plus that of a trainable copy of it, brought to p_prior exp(r/alpha)
   by relative trajectory balance, 1/2 (log Z + alpha (log p_post - log p_prior) - r)^2 over whole
   chains: half of the steps with chains of its own, half with noised points from a pool of the
   buffer and all points seen in training, drawn with weights softmax(r).
5. Candidates: many samples of the posterior are improved by Adam on the score r + alpha log p_prior
   and the best `popsize` of them, clamped to the box, are evaluated.

Where this deviates from the authors' program
---------------------------------------------
- Adam climbs the score itself, not its exponential, and without the divergence part of
  log p_prior, whose gradient the program drops as well; the final ranking has it.
- With schedule="paper" the variances of the noise are 30 numbers from 1e-4 to 0.02, as the paper
  says.  By default they are the program's: 31 from 7.6e-4 to 0.0207, of which it trains and samples
  with all but the cleanest, so that candidates keep more noise.
- With likelihood="exact" log p_prior is that of the model which is sampled (`diffusion.py`), but
  for the noise that schedule="authors" leaves in its points; with alpha = 1e-4 it weighs next to
  nothing in the score.  By default it is the program's own number, see `likelihood.py`: its ODE
  goes the other way round and ends in N(0, 0.0276^2), so that it is no likelihood, but a strong
  pull to the mean of the buffer.
- The first points are the center of the box and uniform ones, like those of the others here.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from fide_lab.baselines.dibo.diffusion import Diffusion
from fide_lab.baselines.dibo.round import Round, RoundOptions
from fide_lab.baselines.stateful import Stateful
from fide_plugins.runtime.schema import GENERATOR, Schema, array, maybe
from fide_plugins.runtime.threads import user_threads
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.options import one_of
from fide_plugins.validation.points import whole_number

__all__ = ["DiBO", "Diffusion", "Round", "RoundOptions"]


class DiBO(Stateful):
    """Diffusion-based Bayesian optimization.  It is slow: minutes a round on a CPU.

    popsize: points a round, 50.
    initial: uniform points before the first round.
    buffer: best points that are remembered.
    proxy_epochs, prior_epochs: passes over the buffer; posterior_epochs: steps of Adam.
    search_epochs: steps of Adam on each sample.
    proposals: M; M times popsize M samples compete for the popsize places of a round.
    diffusion_steps, alpha, gamma: see above.
    width, proxy_width: of the diffusion networks and of the ensemble's.
    batch: examples, or chains, a training step.
    precision: "double" or "single".
    likelihood: "authors", that of their program, or "exact", that of the model; see above.
    schedule: variances of the noise: "authors", those of their program, or "paper"; see above.

    The other options are those of `Baseline`; `sigma0` is not used.  The defaults are those of
    the FIDE paper, which took them from the authors' for problems of like size.

    Raises OptionError (a ValueError).
    """

    name: ClassVar[str] = "dibo"
    own_schema: ClassVar[dict[str, Schema]] = {
        "X": array("b", "d", low=0.0, high=1.0),
        "losses": array("b"),
        "waiting": maybe(array("k", "d", low=0.0, high=1.0)),
        "generator": array("g", kind="u"),
        "rng": GENERATOR,
    }

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        initial: int = 100,
        buffer: int = 300,
        proxy_epochs: int = 50,
        prior_epochs: int = 50,
        posterior_epochs: int = 50,
        search_epochs: int = 30,
        proposals: int = 10,
        diffusion_steps: int = 30,
        alpha: float = 1e-4,
        gamma: float = 1.0,
        width: int = 512,
        proxy_width: int = 256,
        batch: int = 256,
        precision: str = "double",
        likelihood: str = "authors",
        schedule: str = "authors",
        **options: Any,
    ) -> None:
        super().__init__(dim, target, **options)
        self.initial = whole_number("initial", initial, 2)
        self.buffer = whole_number("buffer", buffer, 2)
        self.precision = one_of("double", "single")("precision", precision)
        self.round_options = RoundOptions.checked(
            proxy_epochs=proxy_epochs, prior_epochs=prior_epochs,
            posterior_epochs=posterior_epochs, search_epochs=search_epochs, proposals=proposals,
            diffusion_steps=diffusion_steps, alpha=alpha, gamma=gamma, width=width,
            proxy_width=proxy_width, batch=batch, likelihood=likelihood, schedule=schedule,
        )  # fmt: skip
        self._rng = np.random.default_rng(self.seed)
        self._generator = torch.Generator().manual_seed(int(self._rng.integers(2**63)))
        self._X: Float64 = np.empty((0, self.dim))  # the buffer
        self._losses: Float64 = np.empty(0)
        self._waiting: Float64 | None = None  # candidates of this round

    def _sample(self) -> Float64:
        if len(self._losses) < min(self.initial, self.buffer):
            X = self._rng.random((self.popsize, self.dim))
            if self._population.drawn == 0:
                X[0] = 0.5
            return X
        if self._waiting is None:
            with self._timed("train"):
                self._waiting = self._propose()
        return self._waiting

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        finite = np.isfinite(losses)
        self._X = np.concatenate([self._X, X[finite]])
        self._losses = np.concatenate([self._losses, losses[finite]])
        best = np.argsort(self._losses, kind="stable")[: self.buffer]
        self._X, self._losses = self._X[best], self._losses[best]
        if self._waiting is not None:  # if more was asked, they are the same candidates
            self._population.forget_pending()
        self._waiting = None

    @user_threads
    def _propose(self) -> Float64:
        """One round: candidates (popsize, d) from the buffer."""
        dtype = torch.float64 if self.precision == "double" else torch.float32
        x, y = torch.as_tensor(self._X, dtype=dtype), torch.as_tensor(-self._losses, dtype=dtype)
        mean, std = x.mean(dim=0), x.std(dim=0) + 1e-7
        x, y = (x - mean) / std, (y - y.mean()) / (y.std() + 1e-7)
        proposed: Tensor = Round(self.round_options, x, y, self._generator).candidates(self.popsize)
        candidates: Float64 = (proposed * std + mean).clamp(0.0, 1.0).to(torch.float64).numpy()
        return candidates

    def _default_popsize(self) -> int:
        return 50

    def _own_settings(self) -> dict[str, Any]:
        own = {"initial": self.initial, "buffer": self.buffer, "precision": self.precision}
        return {**own, **self.round_options.as_dict()}

    def _own_state(self) -> dict[str, Any]:
        return {
            "X": self._X,
            "losses": self._losses,
            "waiting": self._waiting,
            "generator": self._generator.get_state(),
            "rng": self._rng.bit_generator.state,
        }

    def _load_own_state(self, state: dict[str, Any]) -> None:
        self._X, self._losses, self._waiting = state["X"], state["losses"], state["waiting"]
        self._generator.set_state(torch.as_tensor(state["generator"], dtype=torch.uint8))
        self._rng.bit_generator.state = state["rng"]
