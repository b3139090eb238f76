"""What FIDE writes into Optuna's storage, and how a sampler reads a study from there.

System attributes, JSON, with a version:

================  ==================================================================================
``fide:ask``      of a trial, written when its parameters are drawn: which candidate it is, and
                  what was decided about other trials (see `trials`)
``fide:image``    of a trial, written by `tell_image`: the features of its image (see `images`)
                  (both with a digest of target and loss: losses of another problem do not count)
``fide:guess``    of trial 0, if it was enqueued: a search of FIDE begins with it
``fide:seed``     of a study: the seed of samplers that were given none
================  ==================================================================================

Anybody may write to a shared database.  So each field that is read is checked, nothing is ever
executed, and an attribute that is not valid is ignored with one warning.

This module uses underscored names of Optuna: `_storage`, `_study_id`, `_trial_id` and
`_get_trials`.  They have no public counterpart that would do: under `HyperbandPruner` a sampler
gets a study without public attributes, and the public methods copy every trial.  Optuna's own
samplers use the same names.  The only other one is `_base_sampler` of `PartialFixedSampler`, in
`sampler`: by it `image_objective` finds the sampler inside.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from optuna.storages import BaseStorage, InMemoryStorage
from optuna.study import Study
from optuna.trial import FrozenTrial, Trial

from fide_plugins.runtime.messages import warn_user

__all__ = [
    "ASK",
    "GUESS",
    "IMAGE",
    "MOST_NAMED",
    "SEED",
    "Ask",
    "TrialReader",
    "Trials",
    "WarnOnce",
    "enqueued_in",
    "id_of",
    "problems_of",
    "read_ask",
    "read_image",
    "read_seed",
    "storage_of",
    "write_attribute",
    "write_image",
    "write_seed",
]

ASK, GUESS, IMAGE, SEED = "fide:ask", "fide:guess", "fide:image", "fide:seed"

MOST_NAMED = 8
"""Trials of each kind that one record may name; further ones are named by the next record."""

Trials = Sequence[FrozenTrial]
"""All trials of a study, in the order of their numbers, which begin at 0."""

_VERSION = 1
_LARGEST = 2**53


# -- records ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Ask:
    """Which candidate a trial got.

    optimizer: digest of search space and settings; generations and slots are comparable only
        between trials in which it is equal.
    generation, slot: name of the candidate, see `fide_adapters.optuna.replica`.
    began: generation in which the search began that the candidate belongs to.
    guided: False if only losses, not images, said where it began.
    proposed: whether a proposer made the candidate.
    skipped: numbers of unfinished trials that nobody waits for from here on.
    late: numbers of skipped trials that have finished since; they count here.
    problem: digest of target and loss, see `images.ImageEvaluator.problem`; None: not recorded.
    """

    optimizer: str
    generation: int
    slot: int
    began: int = 0
    proposed: bool = False
    skipped: tuple[int, ...] = ()
    late: tuple[int, ...] = ()
    guided: bool = True
    problem: str | None = None

    def read_for(self, problem: str | None) -> Ask:
        """Copy that names no optimizer of this problem if the record is of another one.

        Names of candidates, and when a search began, mean nothing to a search for another target.
        """
        if self.problem in (None, problem):
            return self
        return replace(self, optimizer=f"{self.optimizer} {self.problem}")

    def about_trials_before(self, number: int) -> Ask:
        """Copy that names no trials from `number` on; a record can only be about earlier ones."""
        if all(n < number for n in (*self.skipped, *self.late)):
            return self
        skipped, late = (tuple(n for n in all_ if n < number) for all_ in (self.skipped, self.late))
        return replace(self, skipped=skipped, late=late)

    def to_json(self) -> dict[str, Any]:
        """Record for the storage."""
        record: dict[str, Any] = {"v": _VERSION, "m": self.optimizer}
        record |= {"g": self.generation, "i": self.slot}
        optional = {
            "b": self.began,
            "p": int(self.proposed),
            "passed": list(self.skipped),
            "late": list(self.late),
            "a": int(not self.guided),
            "t": self.problem,
        }
        return record | {key: value for key, value in optional.items() if value}


def read_ask(record: Any) -> Ask | None:
    """Undo `Ask.to_json`; None for anything else."""
    if not isinstance(record, dict) or record.get("v") != _VERSION:
        return None
    optimizer, skipped, late = record.get("m"), record.get("passed", []), record.get("late", [])
    counts = [record.get("g"), record.get("i"), record.get("b", 0), record.get("p", 0)]
    counts.append(record.get("a", 0))
    problem = record.get("t")
    if not (isinstance(optimizer, str) and isinstance(skipped, list) and isinstance(late, list)):
        return None
    if not (problem is None or isinstance(problem, str)):
        return None
    if max(len(skipped), len(late)) > MOST_NAMED or not _are_counts([*counts, *skipped, *late]):
        return None
    generation, slot, began, proposed, loss_only = counts
    named = tuple(skipped), tuple(late)
    return Ask(optimizer, generation, slot, began, bool(proposed), *named, not loss_only, problem)


def _are_counts(values: list[Any]) -> bool:
    return all(type(value) is int and 0 <= value < _LARGEST for value in values)


def write_image(codec: str, code: str, problem: str) -> dict[str, Any]:
    """Record of an image: its `code` by the codec with that digest, and that of target and loss."""
    return {"v": _VERSION, "c": codec, "d": code, "t": problem}


def read_image(record: Any, codec: str) -> str | None:
    """Code of an image, written by the codec with that digest; None for anything else."""
    if not isinstance(record, dict) or record.get("v") != _VERSION or record.get("c") != codec:
        return None
    code = record.get("d")
    return code if isinstance(code, str) else None


def problems_of(trial: FrozenTrial) -> set[str]:
    """Digests of target and loss in a trial's valid records; empty if none says it.

    There are two if one sampler asked for the trial, and another told its image.
    """
    image, ask = trial.system_attrs.get(IMAGE), read_ask(trial.system_attrs.get(ASK))
    told = image.get("t") if isinstance(image, dict) and image.get("v") == _VERSION else None
    asked = None if ask is None else ask.problem
    return {problem for problem in (told, asked) if isinstance(problem, str)}


def enqueued_in(trial: FrozenTrial) -> Mapping[str, Any]:
    """Parameters that a user has enqueued the trial with; empty if it was not enqueued."""
    params = trial.system_attrs.get("fixed_params")  # so `Study.enqueue_trial` writes it
    return params if isinstance(params, Mapping) else {}


# -- a study ---------------------------------------------------------------------------------------


def storage_of(study: Study) -> BaseStorage:
    """Storage of a study."""
    return study._storage


def id_of(study: Study) -> tuple[int, str]:
    """Number and name of a study in its storage."""
    return study._study_id, study.study_name


def write_attribute(storage: BaseStorage, trial: Trial | FrozenTrial, key: str, value: Any) -> None:
    """Write a system attribute of a trial that is running."""
    storage.set_trial_system_attr(trial._trial_id, key, value)


def read_seed(study: Study) -> tuple[int | None, bool]:
    """Seed that the study's samplers share, if there is one, and whether the attribute is valid."""
    seed = study._storage.get_study_system_attrs(study._study_id).get(SEED)
    if seed is None:
        return None, True
    return (seed, True) if _are_counts([seed]) else (None, False)


def write_seed(study: Study) -> int:
    """Draw a seed for the study's samplers; returns the one that the storage then has."""
    storage = study._storage
    drawn = int(np.random.SeedSequence().generate_state(1, np.uint64)[0] >> np.uint64(11))
    storage.set_study_system_attr(study._study_id, SEED, drawn)
    seed: int = storage.get_study_system_attrs(study._study_id)[SEED]  # perhaps another worker's
    return seed


class TrialReader:
    """All trials of one study, without copying a list of thousands before each trial.

    Most storages keep track of what is new, or query a database.  `InMemoryStorage` copies its
    list; there each trial is fetched by its number until it has finished.
    """

    def __init__(self) -> None:
        self._trials: list[FrozenTrial] = []
        self._unfinished: set[int] = set()

    def read(self, study: Study) -> Trials:
        """All trials as they are now; do not change the list."""
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


class WarnOnce:
    """Warnings and log entries, each subject once: a sampler is called for thousands of trials."""

    def __init__(self) -> None:
        self.subjects: set[str] = set()
        """Subjects that were reported."""

    def warn(self, subject: str, message: str) -> None:
        """Issue a RuntimeWarning: something is wrong."""
        if subject not in self.subjects:
            self.subjects.add(subject)
            warn_user(message)

    def log(self, subject: str, message: str) -> None:
        """Log a warning: nothing is wrong, but it may not be what the user meant."""
        if subject not in self.subjects:
            self.subjects.add(subject)
            logging.getLogger("fide_adapters.optuna").warning(message)
