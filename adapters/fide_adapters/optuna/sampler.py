"""The sampler, and objectives that return images."""

from __future__ import annotations

import logging
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from optuna.distributions import BaseDistribution
from optuna.samplers import BaseSampler, RandomSampler
from optuna.study import Study, StudyDirection
from optuna.trial import FixedTrial, FrozenTrial, Trial, TrialState

from fide_adapters.image_loss import read_result, views_of
from fide_adapters.optuna.search_space import common
from fide_adapters.optuna.settings import Settings
from fide_adapters.optuna.storage import id_of, storage_of, write_attribute, write_image
from fide_adapters.optuna.study import StudyState
from fide_adapters.optuna.trials import CONSTRAINTS
from fide_plugins.errors import ImageError, OptionError, ProtocolError
from fide_plugins.losses.base import as_losses

_log = logging.getLogger(__name__)
_MOST_STUDIES = 4


class FIDESampler(BaseSampler):
    """Find the parameters whose image is the target.

    A trial that is enqueued before all others, with each parameter, is where the search begins.

    Parameters
    ----------
    target
        image to find, or a list of views, as for `fide_plugins.FIDE`; None: there are no images,
        and the search is CMA-ES.
    mask, weights, value_range
        which pixels count, and which values of target and images are black and white, as for
        `fide_plugins.FIDE`.
    loss
        of an image for which `tell_image` gets no loss: a name in `fide_plugins.losses`, or a
        callable from images to (n,) numbers; None: "mse".
    encoder, popsize, preset, sigma0, device, **options
        as for `fide_plugins.FIDE`.
    seed
        the same seed gives the same study if one worker runs it.  Give all workers the same seed,
        or none of them; then the storage keeps one for all.
    search_space
        distributions by name, if they are known before the first trial; None: the parameters that
        all completed trials have in common.
    independent_sampler
        of parameters that are not searched together, such as conditional ones; None: uniform.
    constraints_func
        as of Optuna's own samplers: a function of a trial that has completed or was pruned, which
        returns a list of numbers, <= 0 where nothing is violated.  A trial that violates one ranks
        behind all that do not.  ``trial.set_constraint`` in the objective does the same.

    Raises
    ------
    ImageError, OptionError, UnknownNameError, LossError
        all ValueErrors: the target or an option is not valid.
    """

    def __init__(
        self,
        target: object = None,
        *,
        loss: str | Callable[..., object] | None = None,
        encoder: str | None = None,
        popsize: int | None = None,
        preset: str = "balanced",
        sigma0: float = 1 / 6,
        seed: int | None = None,
        device: str = "auto",
        mask: object = None,
        weights: object = None,
        value_range: object = None,
        search_space: Mapping[str, BaseDistribution] | None = None,
        independent_sampler: BaseSampler | None = None,
        constraints_func: Callable[[FrozenTrial], Sequence[float]] | None = None,
        **options: Any,
    ) -> None:
        _check_arguments(search_space, independent_sampler, constraints_func)
        options = {"encoder": encoder, "popsize": popsize, **options}
        views = views_of(target, mask, weights, value_range)
        self._settings = Settings(views, loss, preset, sigma0, device, options, seed)
        self._constraints_func = constraints_func
        self._search_space = None if search_space is None else dict(search_space)
        self._independent_sampler = independent_sampler or _NumberedSampler(seed)
        self._reseeded = False
        self._states: OrderedDict[tuple[int, str], StudyState] = OrderedDict()
        self._lock = threading.RLock()

    # -- images ------------------------------------------------------------------------------------

    def tell_image(self, trial: Any, image: object, loss: float | None = None) -> float:
        """Record the image of a trial, and return its loss, for the objective to return.

        trial: that of the objective, not an object that wraps it.  Nothing is recorded for a
            `FrozenTrial` or `FixedTrial`, so an objective can be called with the best trial.
        image: of the target's size, anything that `fide_plugins.FIDE` takes; for a list of targets
            a list of them.  It is encoded at once and not kept.
        loss: None: the sampler's own loss of the image, which needs a target and must be minimized.

        Raises `ImageError`, `LossError` or, in a study of several objectives, `OptionError`, all
        ValueErrors; `ProtocolError` for what is no trial, or without both target and loss.
        """
        running, images = _running_trial(trial, loss is None), self._settings.images
        value = None if loss is None else float(as_losses([loss], 1)[0])
        if images is None:
            if value is None:
                raise ProtocolError(
                    "the loss of an image needs a target: FIDESampler(target=...), or give the "
                    "loss, tell_image(trial, image, loss=...)"
                )
            self._settings.warn(
                "no target",
                "FIDESampler has no target, so it is CMA-ES and uses no images; make it with one, "
                "FIDESampler(target=...), or return the loss alone from the objective",
            )
            return value
        if image is None:
            raise ImageError(
                "tell_image needs the image of the trial, not None; without one return the loss "
                "from the objective, or raise optuna.TrialPruned where the render failed"
            )
        batch = images.read(image)
        value = images.loss(batch) if value is None else value
        if running is not None:
            tokens = images.tokens(batch)
            write_image(running, images.codec.digest, images.codec.pack(tokens), images.problem)
            with self._lock:
                self._state_of(running.study).keep(running.number, tokens)
        return value

    # -- what Optuna calls -------------------------------------------------------------------------

    def infer_relative_search_space(
        self, study: Study, trial: FrozenTrial
    ) -> dict[str, BaseDistribution]:
        """Return the parameters that are searched together, by name."""
        with self._lock:
            state = self._state_of(study)
            space = state.update(study, trial.number)
        if self._search_space is not None:
            return common(self._search_space, self._search_space)
        if state.lost_space:
            self._settings.warn(
                "space",
                "completed trials of the study have no parameter in common, by name and range, so "
                "nothing is searched; if ranges have changed, name those to search, "
                "FIDESampler(search_space={...}), or start a new study",
                _log.warning,
            )
        return dict(space)

    def sample_relative(
        self, study: Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """Return the next candidate, and record in the trial which one it is."""
        _refuse_several_objectives(study)
        if not search_space:
            return {}
        with self._lock:
            return self._state_of(study).ask(study, trial, search_space)

    def sample_independent(
        self,
        study: Study,
        trial: FrozenTrial,
        param_name: str,
        param_distribution: BaseDistribution,
    ) -> Any:
        """Return a value of the independent sampler, or of the first candidate in trial 0."""
        _refuse_several_objectives(study)
        own = isinstance(self._independent_sampler, _NumberedSampler) and not self._reseeded
        if trial.number == 0 and own:
            with self._lock:
                state = self._state_of(study)
                return state.first(study, trial, param_name, param_distribution)
        sampled = self._independent_sampler.sample_independent
        return sampled(study, trial, param_name, param_distribution)

    def before_trial(self, study: Study, trial: FrozenTrial) -> None:
        """Notify the independent sampler."""
        self._independent_sampler.before_trial(study, trial)

    def after_trial(
        self, study: Study, trial: FrozenTrial, state: TrialState, values: Sequence[float] | None
    ) -> None:
        """Record constraints."""
        self._independent_sampler.after_trial(study, trial, state, values)
        if state is TrialState.FAIL:
            with self._lock:
                self._state_of(study).features.pop(trial.number, None)
        elif self._constraints_func is not None:
            violations = [float(value) for value in self._constraints_func(trial)]
            write_attribute(storage_of(study), trial, CONSTRAINTS, violations)
        space = self._search_space or {}
        wrong = [name for name in sorted(space) if trial.distributions.get(name) != space[name]]
        if wrong and state is TrialState.COMPLETE:
            suggested = trial.distributions.get(wrong[0], "not at all")
            self._settings.warn(
                "search_space",
                f"search_space has {wrong[0]!r} as {space[wrong[0]]}, but trial {trial.number} "
                f"suggests it {suggested}: the search goes by search_space, and leaves out trials "
                "that lack a parameter or are outside; make them equal",
            )

    def reseed_rng(self) -> None:
        """Reseed the independent sampler; candidates differ between threads without that."""
        self._reseeded = True
        self._independent_sampler.reseed_rng()

    # -- what was learned --------------------------------------------------------------------------

    def counts(self, study: Study) -> dict[str, int]:
        """How many finished trials counted as what, for the study's latest search space.

        "member", "step", "late" and "altered" were asked by FIDE; "image" is how many
        of these had one; "left out" do not count; "waiting" are behind an unfinished one.
        """
        with self._lock:
            return self._state_of(study).counts(study, self._search_space)

    def _state_of(self, study: Study) -> StudyState:
        """State in a study; of the studies used least recently it is read again."""
        key = id_of(study)
        state = self._states.pop(key, None) or StudyState(self._settings)
        self._states[key] = state  # the latest at the end
        while len(self._states) > _MOST_STUDIES:
            self._states.popitem(last=False)
        return state

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        del state["_lock"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock = threading.RLock()


def image_objective(
    function: Callable[[Trial], Any], sampler: FIDESampler | None = None
) -> Callable[[Trial], float]:
    """Make an objective from a function of a trial that returns an image.

    function: it may also return the path of an image, (loss, image), an `ImageLoss`, or a loss.
    sampler: None: that of the study, also inside a `PartialFixedSampler`.

    The objective raises ProtocolError if the study has no FIDESampler.
    """

    def objective(trial: Trial) -> float:
        result = read_result(function(trial))
        if result.image is None:
            return result.loss  # type: ignore[no-any-return]  # Optuna checks it
        return (sampler or _sampler_of(trial)).tell_image(trial, result.image, result.loss)

    return objective


def _sampler_of(trial: Trial) -> FIDESampler:
    sampler: Any = trial.study.sampler if isinstance(trial, Trial) else None
    while sampler is not None and not isinstance(sampler, FIDESampler):
        sampler = getattr(sampler, "_base_sampler", None)  # PartialFixedSampler has no other name
    if sampler is None:
        raise ProtocolError(
            "image_objective found no FIDESampler in the trial's study; name it: "
            "image_objective(function, sampler)"
        )
    return sampler


class _NumberedSampler(RandomSampler):
    """Uniform parameters from (seed, number of the trial, name): workers do not begin alike."""

    def __init__(self, seed: int | None = None) -> None:
        super().__init__()  # whose generator is not used, and takes no seed beyond 32 bits
        self._entropy = np.random.SeedSequence(seed).entropy

    def reseed_rng(self) -> None:
        """Continue with a seed from the operating system."""
        self._entropy = np.random.SeedSequence().entropy

    def sample_independent(
        self,
        study: Study,
        trial: FrozenTrial,
        param_name: str,
        param_distribution: BaseDistribution,
    ) -> Any:
        """Uniform value, equal for equal trial number and name."""
        key = (trial.number, zlib.crc32(param_name.encode()))
        seeds = np.random.SeedSequence(self._entropy, spawn_key=key).generate_state(1)
        once = RandomSampler(int(seeds[0]))
        return once.sample_independent(study, trial, param_name, param_distribution)


# -- what is refused -------------------------------------------------------------------------------


def _check_arguments(search_space: Any, independent_sampler: Any, constraints_func: Any) -> None:
    kinds = search_space.values() if isinstance(search_space, Mapping) else [None]
    if search_space is not None and not (
        search_space and all(isinstance(one, BaseDistribution) for one in kinds)
    ):
        raise OptionError(
            "search_space must have distributions by name, such as "
            f"{{'x': FloatDistribution(0, 1)}}, not {search_space!r}; leave it out where it is not "
            "known"
        )
    if not isinstance(independent_sampler, BaseSampler | None):
        why = f"independent_sampler must be an Optuna sampler, not {independent_sampler!r}"
        raise OptionError(why)
    if constraints_func is not None and not callable(constraints_func):
        raise OptionError(f"constraints_func is a function of a trial, not {constraints_func!r}")


def _refuse_several_objectives(study: Study) -> None:
    if len(study.directions) > 1:
        raise OptionError(
            f"FIDESampler cannot be used in a study of {len(study.directions)} objectives: an "
            "image has one loss; create the study with one direction"
        )


def _running_trial(trial: object, own_loss: bool) -> Trial | None:
    """Trial of an objective, to record an image in; None for one in which nothing is recorded."""
    if isinstance(trial, FrozenTrial | FixedTrial):
        return None
    if not isinstance(trial, Trial):
        raise ProtocolError(
            "the image is recorded in the optuna.Trial that the objective is given or study.ask "
            f"returns, not in an object of type {type(trial).__name__}; give that trial itself, "
            "also where another object wraps it"
        )
    _refuse_several_objectives(trial.study)
    if own_loss and trial.study.direction is StudyDirection.MAXIMIZE:
        raise ProtocolError(
            "the sampler's own loss must be minimized, but the study maximizes; give a loss, "
            "or create the study with direction='minimize'"
        )
    return trial
