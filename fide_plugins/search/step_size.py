"""The step size of many parameters: two-point adaptation.

Cumulative step-size adaptation (Hansen 2016, eq. 44) needs some d / k generations to notice that
the step size is wrong, which is most of what an expensive renderer can afford.  Two-point
adaptation (Hansen 2008, "CMA-ES with Two-Point Step-Size Adaptation", arXiv:0805.0231; Hansen,
Atamna and Auger 2014, https://hal.inria.fr/hal-00997294) asks instead: of two candidates, as far
along the last step of the mean as against it, which is better?  The constants are those of the
library `cma`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from fide_plugins.types import Float64

__all__ = ["TwoPoint"]

_MEMORY = 0.3  # weight of the newest comparison


class TwoPoint:
    """Whether the last steps of the mean went far enough.

    dim: d, the number of parameters.
    """

    def __init__(self, dim: int) -> None:
        self.damping = 0.7 + 2 * np.log(dim)
        self.shift = np.zeros(dim)  # last step of the mean, in units of sigma
        self.trend = 0.0  # in [-1, 1]; above 0 steps are too short

    def pair(self, y: Float64, lengths: Callable[[Float64], Float64]) -> Float64:
        """Two steps (2, d) along and against the last one, as long as the first sample y (2, d).

        lengths: Mahalanobis lengths (n,) of steps (n, d).  Before the first step: y itself.
        """
        if not self.shift.any():
            return y
        shift_length, length = lengths(np.stack([self.shift, y[0]]))
        ahead = self.shift * (length / shift_length)
        return np.stack([ahead, -ahead])

    def factor(self, shift: Float64, losses: Float64, pair: tuple[int, int] | None) -> float:
        """What to multiply the step size by, after a generation that moved the mean by `shift`.

        losses: (k,) of the generation.  pair: where in it the two steps along and against are; None
            if one of them was lost.
        """
        had_pair, self.shift = bool(self.shift.any()), shift
        if pair is None or not had_pair:
            return 1.0
        ahead, against = (float(np.mean(losses < losses[i])) for i in pair)  # ranks in [0, 1)
        lead = (against - ahead) * len(losses) / (len(losses) - 1)  # in [-1, 1]
        self.trend += _MEMORY * (np.sign(lead) * np.sqrt(abs(lead)) - self.trend)
        return float(np.exp(self.trend / self.damping))

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes."""
        return {"shift": self.shift, "trend": float(self.trend)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put back what `state_dict` gave."""
        self.shift, self.trend = state["shift"], float(state["trend"])
