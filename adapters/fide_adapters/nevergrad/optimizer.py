"""FIDE as a Nevergrad optimizer, and its configuration; the rules are in `reference/nevergrad.md`.

Nevergrad's optimizers are extended by overriding underscored methods.  `_callbacks`, `_num_ask`,
`_running_jobs`, `_finished_jobs` and `_sent_warnings` are used where there is no public way.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import numpy as np
from nevergrad.common import errors
from nevergrad.optimization import base

from fide_adapters.image_loss import Result, read_result
from fide_adapters.nevergrad.parametrization import Cube, initial_candidate
from fide_adapters.nevergrad.search import Search, target_setting
from fide_plugins.errors import ImageError, OptionError, ProtocolError
from fide_plugins.options import make_options
from fide_plugins.runtime.messages import warn_user
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.options import check_names
from fide_plugins.validation.points import new_seed
from fide_plugins.views import Views

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE

_FORMAT = 3  # of dumps
_FAILED = 5.0e20  # what Nevergrad makes of NaN and infinity
_ELSEWHERE = (
    *("target", "mask", "weights", "value_range", "loss", "preset", "encoder", "popsize"),
    *("device", "seed", "x0", "sigma0"),
)


class NoImagesWarning(errors.InefficientSettingsWarning):  # type: ignore[misc]  # no types there
    """FIDE gets no images, so it is CMA-ES."""


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
        self._search = Search(config.config(), self.num_workers)
        self._cube: Cube | None = None  # made when the search begins
        self._asked_key = f"fide:asked:{uuid4().hex}"  # in candidates, of the point that FIDE gave
        self._drawn: list[Any] = []  # candidates that Nevergrad has drawn in this call of ask
        self._repeated: deque[Any] = deque()  # candidates of a dump, to ask again
        self._image: Float32 | None = None  # (1, H, W, 3), of the candidate that is being told

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
            self._search.set_target(None)
        elif former is None or all(view.weights is None for view in former.views):
            values = None if former is None else former.values
            self._search.set_target(Views.read(image, value_range=values))
        else:
            self._search.set_target(former.retargeted(image))

    @property
    def fide(self) -> FIDE:
        """The FIDE that searches, to inspect; ProtocolError before the first `ask` or `tell`."""
        return self._search.fide

    @property
    def num_images(self) -> int:
        """Number of candidates that were told with an image."""
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
            if self._search.target is None:
                self._warn_of_no_images("has no target")
        return self._cube

    def _warn_of_no_images(self, why: str) -> None:
        if NoImagesWarning not in self._sent_warnings:
            self._sent_warnings.add(NoImagesWarning)
            warn_user(
                f"FIDE {why}, so it is CMA-ES; set optimizer.target and tell images, "
                "tell(candidate, loss, image=...), or return ImageLoss(loss, image)",
                NoImagesWarning,
            )

    # -- tell --------------------------------------------------------------------------------------

    def tell(
        self,
        candidate: Any,
        loss: Any,
        constraint_violation: Any = None,
        penalty_style: Any = None,
        *,
        image: object = None,
    ) -> None:
        """Report the result of a candidate, as in Nevergrad.

        loss: the lower the better; an `ImageLoss`; an image, whose loss is then computed; a pair
            (loss, image) or (loss, None); or several losses, as in Nevergrad.
        image: of the candidate: anything that `fide_plugins.FIDE` takes.

        Raises ImageError or LossError, both ValueErrors, before anything changes.
        """
        result = read_result(loss)
        if image is not None:
            if result.image is not None:
                raise ImageError("a candidate's image is told once: in the loss or as an argument")
            result = Result(result.loss, image)
        self._start()
        loss, self._image = self._search.check(result)
        try:
            super().tell(candidate, loss, constraint_violation, penalty_style)
        finally:
            self._image = None

    def _internal_tell_candidate(self, candidate: Any, loss: float) -> None:
        cube = self._start()
        image, self._image = self._image, None
        x = candidate._meta.pop(self._asked_key, None)
        if x is None:
            x = cube.point(candidate)
        failed, penalized = not loss < _FAILED, loss != candidate.loss
        valid = not (failed or penalized)
        self._search.tell(x, np.inf if failed else loss, image, valid)
        if self._search.lacks_images:
            self._warn_of_no_images("gets no images")

    def _internal_provide_recommendation(self) -> Float64 | None:
        if self.parametrization.function.deterministic or not self._search.started:
            return None  # the best candidate told
        best = self._start().candidate(self.fide.recommend())
        z: Float64 = best.get_standardized_data(reference=self.parametrization)
        return z

    # -- minimize ----------------------------------------------------------------------------------

    def minimize(self, *args: Any, **kwargs: Any) -> Any:
        """As in Nevergrad; once an objective has raised, call it again to go on.

        In Nevergrad a failed job would stay the next one to be told, and raise again each time.
        Its candidate is withdrawn; it counts in the budget, as all that were asked.
        """
        try:
            return super().minimize(*args, **kwargs)
        except Exception:
            if self._finished_jobs:  # the first is the one whose result or whose `tell` has raised
                self._withdraw(self._finished_jobs.popleft()[0])
            raise

    def _withdraw(self, candidate: Any) -> None:
        """Say that a candidate, if it is ours, will not be told."""
        x = candidate._meta.pop(self._asked_key, None)
        if x is not None:
            self.fide.withdraw([x])

    # -- dump --------------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        jobs = [candidate for candidate, _ in [*self._finished_jobs, *self._running_jobs]]
        return {
            **self.__dict__,
            "_format": _FORMAT, "_num_ask": self._num_ask - len(jobs),
            "_repeated": deque([*self._repeated, *jobs]), "_running_jobs": [],
            "_finished_jobs": deque(), "_drawn": [], "_image": None,
        }  # fmt: skip

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
        if options is not None and not isinstance(options, Mapping):
            raise OptionError(f"options must be a dictionary of options by name, not {options!r}")
        instead = "is an argument of its own, or init or sigma of the parametrization: not options"
        check_names(options or {}, _ELSEWHERE, instead)
        make_options(preset, {"encoder": encoder, "popsize": popsize, **(options or {})})
        settings = {
            **dict.fromkeys(("mask", "weights", "value_range")),  # which the target has
            "target": target_setting(target, mask, weights, value_range),
            "loss": loss, "preset": preset, "encoder": encoder, "popsize": popsize,
            "device": device, "seed": None if seed is None else new_seed(seed),
            "options": None if options is None else dict(options),
        }  # fmt: skip
        super().__init__(Optimizer, settings, as_config=True)
