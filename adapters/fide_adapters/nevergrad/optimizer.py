"""FIDE as a Nevergrad optimizer, and its configuration.

Nevergrad asks and tells one candidate at a time.  `_internal_ask_candidate` and
`_internal_tell_candidate` are `ask(1)` and `tell` of `fide_plugins.FIDE` in the coordinates of
`parametrization.Cube`.  The rules:

- A candidate that this optimizer asked is reported as the point that FIDE gave, whatever rounding,
  integers and choices have made of its value.  Any other (a suggestion, one of another member of a
  portfolio) is injected.  One whose generation is complete is late, see `fide_plugins.population`.
- The search uses the loss with Nevergrad's penalties; the proposer uses the image.  A loss that is
  NaN or infinite, also minus infinity, ranks last in the search and in Nevergrad, which has 5e20 in
  its place; nothing is learned from its image.
- An initial value that a user has chosen is asked first, to the bit.
- A candidate that violates a cheap constraint is withdrawn.
- An image is used while it is told; no reference to it is kept.
- The recommendation is the best candidate told; if ``parametrization.function.deterministic`` is
  False, it is the mean of the search distribution.
- A dump during `minimize` holds the candidates that the executor evaluates, without their results.
  They are asked first when the search continues.

Nevergrad's optimizers are extended by overriding underscored methods, here the two above and
`_internal_provide_recommendation`.  `_warn`, which reads `_sent_warnings`, is overridden so that
warnings name the user's line.  Four more attributes are used, for which there is no public way:
`_callbacks` and `_num_ask` by `ask`, `_running_jobs` and `_finished_jobs` for jobs that failed, and
all but the first by dumps.  `_meta` of candidates is used as Nevergrad's own optimizers use it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from copy import deepcopy
from inspect import signature
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import numpy as np
from nevergrad.common import errors
from nevergrad.optimization import base

from fide_adapters.image_loss import Result, read_result
from fide_adapters.nevergrad.parametrization import Cube, initial_candidate
from fide_adapters.nevergrad.search import Evaluation, Search, check_options, target_setting
from fide_plugins.errors import ImageError, ProtocolError
from fide_plugins.options import make_options
from fide_plugins.runtime.messages import warn_user
from fide_plugins.types import Float64
from fide_plugins.validation.points import new_seed
from fide_plugins.views import Views

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE

__all__ = ["IMAGE", "DaskExecutor", "NoImagesWarning", "Optimizer", "ParametrizedFIDE"]

IMAGE = "fide:image"
"""Key of ``candidate._meta`` for an image that goes through a portfolio."""

_FORMAT = 2  # of dumps
_FAILED = 5.0e20  # what Nevergrad makes of NaN and infinity


class NoImagesWarning(errors.InefficientSettingsWarning):  # type: ignore[misc]  # no types there
    """FIDE gets no images, so it is CMA-ES."""


def _has_raised(job: Any) -> bool:
    """Whether a job that is done is a future that has an exception, or was cancelled."""
    try:
        return hasattr(job, "exception") and job.exception() is not None
    except Exception:
        return True


def _without_image(candidate: Any) -> Any:
    """A candidate for a dump; a copy if an image is attached, which its optimizer will need."""
    if IMAGE not in candidate._meta:
        return candidate
    shared = candidate.random_state, candidate._meta[IMAGE]
    copy = deepcopy(candidate, {id(one): one for one in shared})
    del copy._meta[IMAGE]
    return copy


class Optimizer(base.Optimizer):  # type: ignore[misc]  # Nevergrad has no types
    """FIDE for one parametrization; made by `ParametrizedFIDE`."""

    def __init__(
        self,
        parametrization: Any,
        budget: int | None = None,
        num_workers: int = 1,
        *,
        config: ParametrizedFIDE,
    ) -> None:
        super().__init__(parametrization, budget=budget, num_workers=num_workers)
        settings = config.config()
        target = settings["target"]
        views = None if target is None else target.views
        self._search = Search(settings, views, self.num_workers)
        self._cube: Cube | None = None  # made when the search begins
        self._asked_key = f"fide:asked:{uuid4().hex}"  # in candidates, of the point that FIDE gave
        self._drawn: list[Any] = []  # candidates that Nevergrad has drawn in this call of ask
        self._repeated: deque[Any] = deque()  # candidates of a dump, to ask again
        self._evaluation: Evaluation | None = None  # of the candidate that is being told
        self._failed_job: Any = None  # the last that raised, while it may be tried again

    @property
    def target(self) -> Any:
        """Image to find, float32 (H, W, 3) in [0, 1] or the value range; None if there is none.

        For several views it is a list.  Set it to any target that `fide_plugins.FIDE` takes, before
        the first `ask` or `tell`; raises ImageError or ProtocolError otherwise.  A range of values
        stays, and so do a mask and weights; then the sizes must, too.
        """
        views = self._search.target
        return None if views is None else views.restored(views.targets)

    @target.setter
    def target(self, image: object) -> None:
        former = self._search.target
        if image is None:
            self._search.target = None
        elif former is None or all(view.weights is None for view in former.views):
            values = None if former is None else former.values
            self._search.target = Views.read(image, value_range=values)
        else:
            self._search.target = former.retargeted(image)

    @property
    def fide(self) -> FIDE:
        """The FIDE that searches, to inspect; ProtocolError before the first `ask` or `tell`."""
        return self._search.fide

    @property
    def num_images(self) -> int:
        """Number of candidates that were told with an image or features."""
        return self._search.num_images

    # -- ask ---------------------------------------------------------------------------------------

    def ask(self) -> Any:
        """Next candidate, as in Nevergrad."""
        if self._repeated:
            for callback in self._callbacks.get("ask", []):
                callback(self)
            self._num_ask += 1
            return self._repeated.popleft()
        asked = None
        try:
            asked = super().ask()
        finally:
            drawn, self._drawn = self._drawn, []
            for candidate in drawn:
                if candidate is not asked:
                    self._withdraw(candidate)
        return asked

    def _internal_ask_candidate(self) -> Any:
        cube = self._start()
        x = self.fide.ask(1)[0]
        if cube.guess is not None and np.array_equal(x, cube.guess):
            candidate = initial_candidate(self.parametrization)
        else:
            candidate = cube.candidate(x)
        candidate._meta[self._asked_key] = x
        self._drawn.append(candidate)
        return candidate

    def _start(self) -> Cube:
        """Begin the search if it has not begun; returns its cube."""
        if self._cube is None:
            cube = Cube(self.parametrization)
            rng = self.parametrization.random_state
            self._search.start(cube, rng)  # fails if the encoder has no weights, for example
            self._cube = cube
            if self.target is None:
                self._warn_of_no_images("has no target")
        return self._cube

    def _warn_of_no_images(self, why: str) -> None:
        self._warn(
            f"FIDE {why}, so it is CMA-ES; set optimizer.target and tell images, "
            "tell(candidate, loss, image=...), or return ImageLoss(loss, image)",
            NoImagesWarning,
        )

    def _warn(self, msg: str, e: Any) -> None:
        """As in Nevergrad, once for each kind of warning, and at the line of the user."""
        if e not in self._sent_warnings:
            self._sent_warnings.add(e)
            warn_user(msg, e)

    # -- tell --------------------------------------------------------------------------------------

    def tell(
        self,
        candidate: Any,
        loss: Any,
        constraint_violation: Any = None,
        penalty_style: Any = None,
        *,
        image: object = None,
        features: object = None,
        version: str | None = None,
    ) -> None:
        """Report the result of a candidate.

        Parameters
        ----------
        candidate, constraint_violation, penalty_style
            as in Nevergrad.
        loss
            the lower the better; an `ImageLoss`; an image, whose loss is then computed; a pair
            (loss, image) or (loss, None); or several losses, as in Nevergrad.
        image
            of the candidate: anything that `fide_plugins.FIDE` takes, or an `ImageRef`.  Through a
            portfolio it comes as ``candidate._meta["fide:image"]``.
        features
            (T, C), in place of an image: its tokens, computed with the optimizer's encoder.
        version
            attribute `version` of the encoder that made the features, which must equal that of the
            optimizer's encoder; None: it is not compared.

        Raises
        ------
        ImageError, FeaturesError, LossError
            all ValueErrors, before anything changes.
        """
        result = read_result(loss)
        if image is not None or features is not None:
            if result.image is not None or result.features is not None:
                raise ImageError("a candidate's image is told once: in the loss or as an argument")
            result = Result(result.loss, image, features, version)
        self._start()
        meta = getattr(candidate, "_meta", {})
        if result.image is None and result.features is None:
            result = result._replace(image=meta.get(IMAGE))
        self._evaluation = self._search.check(result)
        meta.pop(IMAGE, None)
        try:
            super().tell(candidate, self._evaluation.loss, constraint_violation, penalty_style)
        finally:
            self._evaluation = None

    def _internal_tell_candidate(self, candidate: Any, loss: float) -> None:
        cube = self._start()
        self._take_image(candidate)
        evaluation, self._evaluation = self._evaluation or Evaluation(loss), None
        x = candidate._meta.pop(self._asked_key, None)
        if x is None:
            x = cube.point(candidate)
        failed, penalized = not loss < _FAILED, loss != candidate.loss
        valid = not (failed or penalized)
        self._search.tell(x, np.inf if failed else loss, evaluation, valid)
        if self._search.lacks_images:
            self._warn_of_no_images("gets no images")

    def _take_image(self, candidate: Any) -> None:
        """Use the image that a callback has attached since `tell` was called."""
        image = candidate._meta.pop(IMAGE, None)
        if image is not None and self._evaluation is not None and not self._evaluation.has_image:
            self._evaluation = self._search.check(Result(self._evaluation.loss, image))

    def _internal_provide_recommendation(self) -> Float64 | None:
        if self.parametrization.function.deterministic or not self._search.started:
            return None  # the best candidate told
        best = self._start().candidate(self.fide.recommend())
        z: Float64 = best.get_standardized_data(reference=self.parametrization)
        return z

    # -- minimize ----------------------------------------------------------------------------------

    def minimize(self, *args: Any, **kwargs: Any) -> Any:
        """As in Nevergrad; once an objective has raised, call it again to go on.

        In Nevergrad failed jobs would stay the next ones to be told, and raise again each time.
        Their candidates are withdrawn; they count in the budget, as all that were asked.  Without
        an executor a candidate is withdrawn when it has failed twice: Nevergrad renders it again.
        """
        signature(super().minimize).bind(*args, **kwargs)  # else a TypeError, of no job
        if self.budget is None:
            return super().minimize(*args, **kwargs)  # which says so
        try:
            return super().minimize(*args, **kwargs)
        except Exception:
            if self._finished_jobs:  # the first is the one whose result or whose `tell` has raised
                first = self._finished_jobs[0]
                if hasattr(first[1], "exception") or first is self._failed_job:
                    self._withdraw(self._finished_jobs.popleft()[0])
                self._failed_job = first
            for job in [job for job in self._finished_jobs if _has_raised(job[1])]:
                self._finished_jobs.remove(job)
                self._withdraw(job[0])
            raise

    def _withdraw(self, candidate: Any) -> None:
        """Say that a candidate will not be told; if it is not ours, nothing happens."""
        x = candidate._meta.pop(self._asked_key, None)
        if x is not None:
            self.fide.withdraw([x])

    # -- dump --------------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        jobs = [candidate for candidate, _ in [*self._finished_jobs, *self._running_jobs]]
        return {
            **self.__dict__,
            "_format": _FORMAT,
            "_num_ask": self._num_ask - len(jobs),
            "_repeated": deque(_without_image(one) for one in [*self._repeated, *jobs]),
            "_running_jobs": [],
            "_finished_jobs": deque(),
            "_drawn": [],
            "_evaluation": None,
            "_failed_job": None,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        if state.get("_format") != _FORMAT:
            raise ProtocolError(
                "this optimizer was dumped by another version of fide-plugins, which alone reads "
                "it; load it with that one, or make a new optimizer and tell it the known results"
            )
        self.__dict__.update(state)


class ParametrizedFIDE(base.ConfiguredOptimizer):  # type: ignore[misc]  # Nevergrad has no types
    """FIDE with settings; it uses images, and not only their losses.

    Call it as any Nevergrad optimizer: ``(parametrization, budget=None, num_workers=1)``.

    Parameters
    ----------
    target
        image to find, or a list of views, anything that `fide_plugins.FIDE` takes; None: set
        ``optimizer.target`` before the first `ask`, or search without images, which is CMA-ES.
    mask, weights, value_range
        which pixels of the target count, and which values of target and images are black and white,
        as in `fide_plugins.FIDE`; images inside of ``optimizer.fide`` are scaled to [0, 1].
    loss
        of images that are told without a loss: a name in `fide_plugins.losses`, or a callable from
        images (n, H, W, 3) to (n,) numbers; None: "mse".
    preset, encoder, popsize, device
        as in `fide_plugins.FIDE`, but a generation has at least as many candidates as there are
        workers.
    seed
        of the search; None: drawn from ``parametrization.random_state`` at the first `ask`.
    options
        any other fields of `fide_plugins.options.Options`, by name.

    Raises
    ------
    ImageError, OptionError, UnknownNameError
        all ValueErrors: the target or an option is not valid.
    TypeError
        for an unknown argument.
    """

    def __init__(
        self,
        *,
        target: object = None,
        mask: object = None,
        weights: object = None,
        value_range: object = None,
        loss: str | Callable[..., object] | None = None,
        preset: str = "balanced",
        encoder: str | None = None,
        popsize: int | None = None,
        device: str = "auto",
        seed: int | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        check_options(options)
        make_options(preset, {"encoder": encoder, "popsize": popsize, **(options or {})})
        settings = {
            "target": target_setting(target, mask, weights, value_range),
            "mask": None,  # which the target has
            "weights": None,
            "value_range": None,
            "loss": loss,
            "preset": preset,
            "encoder": encoder,
            "popsize": popsize,
            "device": device,
            "seed": None if seed is None else new_seed(seed),
            "options": None if options is None else dict(options),
        }
        super().__init__(Optimizer, settings, as_config=True)


class DaskExecutor:
    """A Dask client as an executor, for parameters of any name and for noisy renderers.

    ``Client.submit`` itself uses some argument names: ``key``, ``workers``, ``retries`` and others
    never reach the objective.  It also returns an earlier result for a call with equal arguments.

    client: a `distributed.Client`.
    """

    def __init__(self, client: Any) -> None:
        self._client = client

    def submit(self, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Future of ``function(*args, **kwargs)``; the function is called each time."""
        return self._client.submit(_call, function, args, kwargs, pure=False)


def _call(function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    return function(*args, **kwargs)
