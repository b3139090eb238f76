"""The sampler, objectives that return images, and what a sampler refuses and warns of."""

from __future__ import annotations

import math
import threading
import zlib
from collections.abc import Callable, Mapping, Sequence
from inspect import currentframe
from types import FrameType
from typing import Any

import numpy as np
from optuna.distributions import BaseDistribution
from optuna.samplers import BaseSampler, RandomSampler
from optuna.storages import BaseStorage
from optuna.study import Study, StudyDirection
from optuna.trial import FixedTrial, FrozenTrial, Trial, TrialState
from torch import Tensor

from fide_adapters.image_loss import is_image, read_result
from fide_adapters.optuna.images import ImageEvaluator
from fide_adapters.optuna.settings import Settings, check_sampler, check_space
from fide_adapters.optuna.storage import (
    GUESS,
    IMAGE,
    WarnOnce,
    enqueued_in,
    storage_of,
    write_attribute,
    write_image,
)
from fide_adapters.optuna.study import StudyState, StudyStates
from fide_adapters.optuna.trials import CONSTRAINTS
from fide_plugins.errors import ImageError, OptionError, ProtocolError
from fide_plugins.losses.base import as_losses
from fide_plugins.validation.points import whole_number
from fide_plugins.views.views import views_of

__all__ = ["FIDESampler", "image_objective"]


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
        the last ten trials had in common.
    n_startup_trials
        number of trials that the independent sampler draws first.
    independent_sampler
        of parameters that are not searched together, such as conditional ones; None: uniform.
    consider_pruned_trials
        whether a pruned trial counts, with its last intermediate value.
    constraints_func
        as of Optuna's own samplers: a function of a trial that has completed or was pruned, which
        returns a list of numbers, <= 0 where nothing is violated.  A trial that violates one ranks
        behind all that do not.  ``trial.set_constraint`` in the objective does the same.
    artifact_store
        of `optuna.artifacts`: `tell_image` stores each image there, and trials without features
        are evaluated from their images there.

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
        n_startup_trials: int = 0,
        independent_sampler: BaseSampler | None = None,
        consider_pruned_trials: bool = False,
        constraints_func: Callable[[FrozenTrial], Sequence[float]] | None = None,
        artifact_store: Any = None,
        **options: Any,
    ) -> None:
        self._settings = Settings(
            views_of(target, mask, weights, value_range),
            loss,
            preset,
            sigma0,
            device,
            {"encoder": encoder, "popsize": popsize, **options},
            seed=seed,
            artifact_store=artifact_store,
            consider_pruned=consider_pruned_trials,
        )
        self._constraints_func = _check_function("constraints_func", constraints_func)
        self._search_space = check_space(search_space)
        self._n_startup_trials = whole_number("n_startup_trials", n_startup_trials, 0)
        self._independent_sampler = check_sampler(independent_sampler) or _NumberedSampler(seed)
        self._reseeded = False
        self._states = StudyStates(self._settings)
        self._lock = threading.RLock()

    # -- images ------------------------------------------------------------------------------------

    def tell_image(self, trial: Any, image: object, loss: float | None = None) -> float:
        """Record the image of a trial, and return its loss, for the objective to return.

        trial: that of the objective, not an object that wraps it.  Nothing is recorded for a
            `FrozenTrial` or `FixedTrial`, so an objective can be called with the best trial.
        image: of the target's size, anything that `fide_plugins.FIDE` takes, or an `ImageRef`; for
            a list of targets a list of them.
        loss: None: the sampler's own loss of the image, which must be minimized.

        The image is encoded at once and not kept.  A sampler without a target needs the loss, and
        does not use the image, with one warning.

        Raises, before anything is recorded, `ImageError`, `LossError` or, in a study of several
        objectives, `OptionError`, all ValueErrors, and `ProtocolError` for a sampler without target
        and loss and for what is no trial.
        """
        if image is None:
            raise ImageError(
                "tell_image needs the image of the trial, not None; without one return the loss "
                "from the objective, or raise optuna.TrialPruned where the render failed"
            )
        if loss is not None and self._settings.images is None:
            return self._loss_alone(trial, loss)
        images = self._images()
        running, batch = _running_trial(trial, loss is None), images.read(image)
        value = images.loss(batch) if loss is None else float(as_losses([loss], 1)[0])
        if running is not None:
            self._record(running.study, running.storage, running, images.tokens(batch))
            if self._settings.artifacts is not None:
                self._settings.artifacts.save(running, images.evaluator.views.split(batch))
        return value

    def tell_features(
        self, trial: Any, features: object, loss: float, *, version: str | None = None
    ) -> float:
        """Record the features of a trial's image, computed elsewhere, and return the loss.

        features: (T, C) or (1, T, C), from `encoders.make(NAME)(images)`, where NAME is the
            sampler's encoder and the images have the target's size.
        version: attribute `version` of the encoder that made the features, which must equal that
            of the sampler's encoder; None: it is not compared.

        A sampler without a target does not use the features, with one warning.

        Raises `FeaturesError`, a ValueError; otherwise as `tell_image`.
        """
        if self._settings.images is None:
            return self._loss_alone(trial, loss)
        tokens, running = self._images().check(features, version), _running_trial(trial, False)
        value = float(as_losses([loss], 1)[0])
        if running is not None:
            self._record(running.study, running.storage, running, tokens)
        return value

    def image_objective(self, function: Callable[[Trial], Any]) -> Callable[[Trial], float]:
        """Make an objective from a function that returns an image; see `image_objective`."""
        return image_objective(function, self)

    def _images(self) -> ImageEvaluator:
        if self._settings.images is None:
            raise ProtocolError(
                "the loss of an image needs a target: FIDESampler(target=...), or give the loss, "
                "tell_image(trial, image, loss=...)"
            )
        return self._settings.images

    def _loss_alone(self, trial: Any, loss: float) -> float:
        """The loss of a trial whose image means nothing, since there is no target."""
        _running_trial(trial, False)
        value = float(as_losses([loss], 1)[0])
        self._settings.warnings.warn(
            "no target",
            "FIDESampler has no target, so it is CMA-ES and uses no images; make it with one, "
            "FIDESampler(target=...), or return the loss alone from the objective",
        )
        return value

    def _record(
        self, study: Study, storage: BaseStorage, trial: Trial | FrozenTrial, tokens: Tensor
    ) -> None:
        images = self._images()
        codec = images.codec
        record = write_image(codec.digest, codec.pack(tokens), images.problem)
        write_attribute(storage, trial, IMAGE, record)
        with self._lock:
            self._state_of(study).keep(trial.number, tokens)

    # -- what Optuna calls -------------------------------------------------------------------------

    def infer_relative_search_space(
        self, study: Study, trial: FrozenTrial
    ) -> dict[str, BaseDistribution]:
        """Return the parameters that are searched together, by name."""
        with self._lock:
            relative = self._state_of(study).update(study, trial.number)
            if relative.completed < self._n_startup_trials:
                return {}
            return dict(relative.current if self._search_space is None else self._search_space)

    def sample_relative(
        self, study: Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """Return the next candidate, and record in the trial which one it is."""
        _refuse_several_objectives(study)
        if self._settings.images is None:
            self._settings.warnings.log("target", "FIDESampler without a target is CMA-ES")
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
        if trial.number == 0 and own and not self._n_startup_trials:
            with self._lock:
                state = self._state_of(study)
                return state.first(study, trial, param_name, param_distribution)
        return self._independent_sampler.sample_independent(
            study, trial, param_name, param_distribution
        )

    def before_trial(self, study: Study, trial: FrozenTrial) -> None:
        """Notify the independent sampler, and note where the search begins."""
        begins = trial.number == 0 and not self._n_startup_trials
        if begins and enqueued_in(trial):
            write_attribute(storage_of(study), trial, GUESS, True)
        self._independent_sampler.before_trial(study, trial)

    def after_trial(
        self,
        study: Study,
        trial: FrozenTrial,
        state: TrialState,
        values: Sequence[float] | None,
    ) -> None:
        """Record constraints, and the features of an image that is in the artifact store."""
        self._independent_sampler.after_trial(study, trial, state, values)
        if self._constraints_func is not None and state is not TrialState.FAIL:
            violations = _as_constraints(self._constraints_func(trial))
            write_attribute(storage_of(study), trial, CONSTRAINTS, violations)
        if self._search_space is not None and state is TrialState.COMPLETE:
            _warn_of_space(self._search_space, trial, self._settings.warnings)
        with self._lock:
            known = self._state_of(study)
            if state is TrialState.FAIL:
                known.features.pop(trial.number, None)
                _warn_of_bare_image(self._settings.warnings)
                return
            tokens = None if IMAGE in trial.system_attrs else known.from_artifact(study, trial)
            if tokens is not None:
                self._record(study, storage_of(study), trial, tokens)

    def reseed_rng(self) -> None:
        """Reseed the independent sampler; candidates differ between threads without that."""
        self._reseeded = True
        self._independent_sampler.reseed_rng()

    # -- what was learned --------------------------------------------------------------------------

    def counts(self, study: Study) -> dict[str, int]:
        """How many finished trials of the study counted as what, for its latest search space.

        - "member": a candidate of the generation that was current when the trial was processed.
        - "late": a candidate of an earlier generation of the same search, or one asked when all
          candidates of the generation were pending.
        - "altered": a candidate of the current generation, but with other parameters, because some
          were fixed by the user or another machine rounds differently.
        - "injected": never asked for by FIDE (added, drawn by another sampler, enqueued after the
          first trial), or asked for in a search that is over.
        - "image": how many of these had an image.
        - "left out": failed, pruned, of another search space, or scored against another target or
          by another loss.
        - "waiting": completed, but not processed before an earlier trial finishes or is skipped.

        A key may be absent if its count is zero.  See `fide_adapters.optuna.replica`.
        """
        with self._lock:
            return self._state_of(study).counts(study, self._search_space)

    def _state_of(self, study: Study) -> StudyState:
        return self._states.of(study)

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

    function: the image may be a path, too; it may also return (loss, image), an `ImageLoss`, or a
        loss without image.
    sampler: None: that of the study, also inside a `PartialFixedSampler`.

    The objective raises ProtocolError if the study has no FIDESampler.

        study.optimize(image_objective(render), n_trials=1000)
    """

    def objective(trial: Trial) -> float:
        result = read_result(function(trial))
        if result.image is None and result.features is None:
            return result.loss  # type: ignore[no-any-return]  # Optuna checks it
        teller = sampler or _sampler_of(trial)
        if result.image is None:
            return teller.tell_features(trial, result.features, result.loss, version=result.version)
        return teller.tell_image(trial, result.image, result.loss)

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
    """Uniform parameters from (seed, number of the trial, name of the parameter).

    With a plain `RandomSampler` all workers of equal seed would begin with the same parameters.
    """

    def __init__(self, seed: int | None = None) -> None:
        super().__init__()  # whose generator is not used, and takes no seed beyond 32 bits
        self._entropy = np.random.SeedSequence(seed).entropy

    def reseed_rng(self) -> None:
        """Continue with a seed from the operating system."""
        super().reseed_rng()
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


# -- what is refused, and warned of ----------------------------------------------------------------


def _check_function(name: str, function: Any) -> Any:
    """Return a function, or None; raises OptionError (a ValueError) for anything else."""
    if function is not None and not callable(function):
        raise OptionError(f"{name} must be a function of a trial, not {function!r}")
    return function


def _as_constraints(values: Any) -> list[float]:
    """What a `constraints_func` has returned, as it is stored; raises OptionError."""
    try:
        numbers = [float(value) for value in values]
    except (TypeError, ValueError):
        numbers = [math.nan]
    if any(map(math.isnan, numbers)):
        raise OptionError(
            "constraints_func must return a list of numbers, <= 0 where nothing is violated, not "
            f"{values!r}"
        )
    return numbers


def _warn_of_bare_image(warnings: WarnOnce) -> None:
    """Warn if the objective of a trial that fails now has returned an image.

    That is an array of two or more axes, alone or in a pair (loss, image); Optuna itself reports
    anything else.  Optuna tells a sampler that a trial failed, but not with which value.  The value
    is a local variable of the function of Optuna that calls the sampler; nothing is said where it
    is not found.  An error would be lost: Optuna replaces those of a trial that has failed.
    """
    frame: FrameType | None = currentframe()
    while frame is not None and frame.f_code.co_name != "_tell_with_warning":
        frame = frame.f_back
    value: Any = None if frame is None else frame.f_locals.get("value_or_values")
    pair = isinstance(value, tuple) and len(value) == 2
    image = value[1] if pair else value
    if not (is_image(image) and hasattr(image, "ndim")):
        return
    what = "a pair (loss, image), the image" if pair else "an image,"
    warnings.warn(
        "bare image",
        f"the objective returned {what} a {type(image).__name__} of shape {tuple(image.shape)}, "
        "where Optuna takes a loss, so its trials fail; wrap it: "
        "study.optimize(image_objective(objective)), with image_objective of "
        "fide_adapters.optuna, or return sampler.tell_image(trial, image)",
    )


def _refuse_several_objectives(study: Study) -> None:
    """Raise OptionError, a ValueError, if the study has more than one objective."""
    if len(study.directions) > 1:
        raise OptionError(
            f"FIDESampler cannot be used in a study of {len(study.directions)} objectives: an "
            "image has one loss; create the study with one direction"
        )


def _running_trial(trial: object, own_loss: bool) -> Trial | None:
    """Trial of an objective, to record an image in; None for one in which nothing is recorded.

    own_loss: whether the loss is the sampler's own, which must be minimized.

    Raises OptionError, a ValueError, if the study has several objectives, and ProtocolError for
    whatever is no trial, or maximizes the sampler's own loss.
    """
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


def _warn_of_space(
    space: Mapping[str, BaseDistribution], trial: FrozenTrial, warnings: WarnOnce
) -> None:
    """Warn of a completed trial that does not have the parameters of `space` as they are there."""
    missing = space.keys() - trial.params.keys()
    if missing:
        warnings.warn(
            "search_space",
            f"trial {trial.number} has no {', '.join(sorted(missing))}, which search_space "
            "names, so it is left out; name only parameters that every trial has",
        )
    for name in space.keys() - missing:
        given, own = space[name], trial.distributions[name]
        if given != own:
            warnings.warn(
                "distribution",
                f"the objective suggests {name!r} from {own}, but search_space has {given}: the "
                "search goes by search_space and covers only what is in both; make them equal",
            )
