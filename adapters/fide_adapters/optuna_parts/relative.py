"""Which parameters are searched together, found from what recent trials had.

Those that the last ten completed trials have all had, with the same distribution.  So a parameter
that sometimes is absent, or whose range keeps changing, is left to the independent sampler, and one
that has changed for good is searched again ten trials later.  A study that changes too often
falls back to what all of its trials have had.

Before any trial has completed it is what the first of those that are running has so far, so that
workers that begin together, and trials that are asked in a batch, are candidates of one generation.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

from optuna.distributions import BaseDistribution
from optuna.trial import FrozenTrial, TrialState

from fide_adapters.optuna_parts.space import by_name
from fide_adapters.optuna_parts.voice import Voice

__all__ = ["RelativeSpace"]

_RECENT = 10
_MOST_SPACES = 8

Distributions = Mapping[str, BaseDistribution]


class RelativeSpace:
    """The space of recent trials.

    voice: notes that the space has changed.
    """

    def __init__(self, voice: Voice) -> None:
        self.completed = 0
        """Trials that were seen."""
        self._voice = voice
        self._recent: deque[Distributions] = deque(maxlen=_RECENT)
        self._always: dict[str, BaseDistribution] | None = None
        self._spaces: list[dict[str, BaseDistribution]] = []
        self._current: dict[str, BaseDistribution] = {}

    def add(self, trial: FrozenTrial) -> None:
        """See a trial that has finished."""
        if trial.state is not TrialState.COMPLETE:
            return
        self.completed += 1
        seen = trial.distributions
        last = self._recent[-1] if self._recent else None
        same = last is not None and seen == last
        self._recent.append(last if same and last is not None else seen)
        if not same:
            self._always = _common([seen if self._always is None else self._always, seen])
        if not same or len(set(map(id, self._recent))) > 1 or not self._current:
            self._decide()

    def begin(self, running: Mapping[str, BaseDistribution]) -> None:
        """Take what a running trial has, while none has completed."""
        if not self.completed:
            self._current = _common([running])

    @property
    def current(self) -> dict[str, BaseDistribution]:
        """Distributions by name, in order; empty where nothing is known."""
        return self._current

    def _decide(self) -> None:
        space = _common(list(self._recent))
        if space not in self._spaces:
            if len(self._spaces) == 1:
                self._voice.note(
                    "space",
                    "the search space of the study has changed; parameters that have not been the "
                    f"same in the last {_RECENT} trials are sampled independently",
                )
            if len(self._spaces) < _MOST_SPACES:
                self._spaces.append(space)
            else:
                space = self._always or {}
        self._current = space


def _common(several: list[Distributions]) -> dict[str, BaseDistribution]:
    """What is in all of them, and varies."""
    first, *others = several
    names = [n for n in sorted(first, key=by_name) if not first[n].single()]
    distinct = {id(other): other for other in others if other is not first}.values()
    return {n: first[n] for n in names if all(o.get(n) == first[n] for o in distinct)}
