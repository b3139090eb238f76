"""What FIDE writes into Optuna's storage, and how it is read: JSON, with a version.

Anybody may write to a shared database, so each field that is read is checked, nothing is ever
executed, and an attribute that is not valid is ignored with one warning.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from optuna.storages import BaseStorage
from optuna.study import Study
from optuna.trial import FrozenTrial, Trial

from fide_plugins.runtime.messages import warn_user

ASK, IMAGE, SEED = "fide:ask", "fide:image", "fide:seed"

MOST_NAMED = 8
"""Trials of each kind that one record may name; further ones are named by the next record."""

Trials = Sequence[FrozenTrial]
"""All trials of a study, in the order of their numbers, which begin at 0."""

_VERSION = 2
_LARGEST = 2**53


@dataclass(frozen=True, slots=True)
class Ask:
    """Which candidate a trial got, written when its parameters are drawn.

    optimizer: digest of settings, problem and search space; names are comparable where it is equal.
    generation, slot: name of the candidate.  began, guided: when its search began; by images?
    proposed: whether a proposer made the candidate.  step: it is a Gauss-Newton step, in no slot.
    skipped: numbers of unfinished trials that nobody waits for from here on.
    late: numbers of skipped trials that have finished since; they count here.
    problem: digest of target and loss; None without a target.
    """

    optimizer: str
    generation: int
    slot: int
    began: int = 0
    guided: bool = True
    proposed: bool = False
    skipped: tuple[int, ...] = ()
    late: tuple[int, ...] = ()
    problem: str | None = None
    step: bool = False


def write_ask(storage: BaseStorage, trial: FrozenTrial, ask: Ask) -> None:
    """Record which candidate a trial got."""
    write_attribute(storage, trial, ASK, {"v": _VERSION, **asdict(ask)})


def read_ask(trial: FrozenTrial) -> Ask | None:
    """Record of a trial; None if there is no valid one."""
    fields = _fields(trial, ASK)
    try:
        ask = Ask(**fields)
        named = [*ask.skipped, *ask.late]
        valid = (
            isinstance(ask.optimizer, str)
            and isinstance(ask.problem, str | None)
            and _are_counts([ask.generation, ask.slot, ask.began, *named])
            and {type(ask.guided), type(ask.proposed), type(ask.step)} == {bool}
            and max(len(ask.skipped), len(ask.late)) <= MOST_NAMED
            and all(number < trial.number for number in named)  # it is about earlier trials
        )
    except TypeError:
        return None
    return ask if valid else None


def write_image(trial: Trial, codec: str, code: str, problem: str) -> None:
    """Record the `code` of an image by the codec with that digest, and that of target and loss."""
    record = {"v": _VERSION, "codec": codec, "code": code, "problem": problem}
    write_attribute(storage_of(trial.study), trial, IMAGE, record)


def read_image(trial: FrozenTrial, codec: str) -> str | None:
    """Code of a trial's image, by the codec with that digest; None if there is no valid one."""
    fields = _fields(trial, IMAGE)
    code = fields.get("code")
    return code if isinstance(code, str) and fields.get("codec") == codec else None


def problem_of(trial: FrozenTrial) -> str | None:
    """Digest of target and loss by which a trial was scored; None if no valid record says it."""
    told, ask = _fields(trial, IMAGE).get("problem"), read_ask(trial)
    if isinstance(told, str):
        return told
    return None if ask is None else ask.problem


def _fields(trial: FrozenTrial, key: str) -> dict[str, Any]:
    """Fields of a record of this version; {} for anything else."""
    record = trial.system_attrs.get(key)
    if not isinstance(record, Mapping) or record.get("v") != _VERSION:
        return {}
    return {name: value for name, value in record.items() if name != "v"}


def _are_counts(values: list[Any]) -> bool:
    return all(type(value) is int and 0 <= value < _LARGEST for value in values)


# -- a study ---------------------------------------------------------------------------------------
# Underscored names of Optuna, which its own samplers use, too: under `HyperbandPruner` a sampler
# gets a study without public attributes, and the public methods copy every trial.


def storage_of(study: Study) -> BaseStorage:
    """Storage of a study."""
    return study._storage


def id_of(study: Study) -> tuple[int, str]:
    """Number and name of a study in its storage."""
    return study._study_id, study.study_name


def read_trials(study: Study) -> Trials:
    """All trials as they are now; do not change them."""
    return study._storage.get_all_trials(study._study_id, deepcopy=False)


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


class WarnOnce:
    """Warnings, each subject once: a sampler is called for thousands of trials."""

    def __init__(self) -> None:
        self._subjects: set[str] = set()

    def __call__(
        self, subject: str, message: str, say: Callable[[str], object] = warn_user
    ) -> None:
        """Issue a RuntimeWarning, or `say` it."""
        if subject not in self._subjects:
            self._subjects.add(subject)
            say(message)
