"""All trials of a study, without copying a list of thousands before each.

Storages other than Optuna's in memory know what is new themselves, or ask a database; that one
copies its list.  There a trial is fetched by its number, as long as it has not finished.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from optuna.storages import InMemoryStorage
from optuna.study import Study
from optuna.trial import FrozenTrial

from fide_adapters.optuna_parts.history import Trials

__all__ = ["Reader"]


class Reader:
    """Of one study."""

    def __init__(self) -> None:
        self._trials: list[FrozenTrial] = []
        self._unfinished: set[int] = set()

    def read(self, study: Study) -> Trials:
        """All trials as they are now; the list is not to be changed."""
        if not isinstance(study._storage, InMemoryStorage):
            return study._get_trials(deepcopy=False, use_cache=False)
        self._fetch_new(study._storage, study._study_id)
        for number in sorted(self._unfinished):
            trial = study._storage.get_trial(self._trials[number]._trial_id)
            self._trials[number] = trial
            if trial.state.is_finished():
                self._unfinished.discard(number)
        return self._trials

    def _fetch_new(self, storage: InMemoryStorage, study_id: int) -> None:
        while True:
            number = len(self._trials)
            try:
                trial_id = storage.get_trial_id_from_study_id_trial_number(study_id, number)
            except KeyError:  # there are no more
                return
            self._trials.append(storage.get_trial(trial_id))
            self._unfinished.add(number)

    def __getstate__(self) -> Mapping[str, Any]:
        return {"_trials": [], "_unfinished": set()}
