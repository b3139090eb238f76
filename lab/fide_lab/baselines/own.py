"""An optimizer of the user: ``FILE.py:NAME`` or ``module:NAME``, a class with ask and tell.

    class Search:
        def __init__(self, dim, seed=None): ...     # of dim, target, seed, budget: those it names
        def ask(self, n): ...                       # (n, dim) in [0, 1]
        def tell(self, X, losses): ...              # or tell(self, X, images, losses)

The other parameters of the constructor are its options, as of ``--set``; any, if it has
``**options``.  Two more attributes are optional: `popsize`, the n that it is asked for, by default
4 + 3 ln dim; and `recommend()`, a point (dim,), by default the best.

`tell` gets the points (n, dim) of one `ask`, all of them, as they were asked; the images (n, H, W,
3), float32 in [0, 1]; and the losses (n,), infinite where a loss was NaN.  A generation that the
budget cuts short is not told.  `recommend` is tried once after the first generation, so that a
wrong one does not cost the budget.  NumPy's and Python's global generators are seeded for it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np

from fide_lab.baselines.base import Replayed, needed_images
from fide_lab.baselines.libraries import GlobalRandom
from fide_plugins.errors import CheckpointError, OptionError, PointsError
from fide_plugins.runtime.registry import Referent, module_fingerprint, shown_traceback
from fide_plugins.runtime.schema import array, check, maybe
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.points import as_points, whole_number

__all__ = ["Own", "own"]

_REFERENT = Referent(
    "optimizer",
    "class",
    "a class with ask and tell",
    "classes",
    "write FILE.py:NAME or module:NAME, such as mine.py:Search; nevergrad:NAME, optuna:NAME; or a "
    "name of: fide list optimizers",
)
_GIVEN = ("dim", "target", "seed", "budget")  # arguments of the constructor


class Own(Replayed):
    """A user's optimizer with all that a baseline has; `own` makes the class of a reference.

    budget: evaluations that are planned.
    options: of the user's constructor.

    It is saved as what it was asked and told.  One that takes images cannot be saved so before its
    budget is told: loading raises CheckpointError (a ValueError), as it does if the replay asks for
    other candidates.

    source: fingerprint of the file that `made_by`, the user's class, was loaded from.

    Raises OptionError (a ValueError), with the traceback, if the constructor raises an exception,
    or if what it makes breaks the protocol.
    """

    keeps_features: ClassVar[bool] = False
    made_by: ClassVar[Callable[..., Any]]
    source: ClassVar[str | None] = None

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        loss: Any = None,
        seed: int | None = None,
        device: str = "auto",
        budget: int = 10_000,
        **options: Any,
    ) -> None:
        super().__init__(dim, target, loss=loss, seed=seed, device=device)
        self.budget, self._options = whole_number("budget", budget, 1), options
        taken = inspect.signature(self.made_by).parameters
        given = {name: getattr(self, name) for name in _GIVEN if name in taken}
        self._global_random = GlobalRandom(self.seed)
        self._user = self._made({**given, **options})
        _check_methods(self.name, self._user)
        self.popsize = whole_number("popsize", getattr(self._user, "popsize", self.popsize), 1)
        names = list(inspect.signature(self._user.tell).parameters)
        self._images_at = names.index("images") if "images" in names else None
        self._recommends, self._tried = callable(getattr(self._user, "recommend", None)), False
        self._asked: Float64 | None = None  # last generation
        self._last_word: Float64 | None = None  # recommended, where that is all that was loaded

    def _made(self, arguments: dict[str, Any]) -> Any:
        """What the user's constructor makes."""
        try:
            with self._global_random.lent():
                return self.made_by(**arguments)
        except Exception as error:
            raise OptionError(
                f"{self.name} cannot be made; mend this error in it:\n"
                f"{shown_traceback(error, __file__)}"
            ) from None  # the message has its traceback

    @contextmanager
    def _called(self) -> Iterator[None]:
        """Around calls of the user's methods.

        An OSError of theirs would be taken for one of the run directory, which needs no traceback.
        """
        try:
            with self._global_random.lent():
                yield
        except OSError as error:
            raise RuntimeError(f"{self.name} raised {error!r}") from error

    @property
    def resumable(self) -> bool:
        """Whether what is saved can be loaded: not if it takes images and more are to come."""
        return self._images_at is None or self._is_finished

    @classmethod
    def option_names(cls) -> list[str]:
        """Names of the options that it takes; empty where it takes any, by ``**options``."""
        parameters = inspect.signature(cls.made_by).parameters.values()
        if any(p.kind is p.VAR_KEYWORD for p in parameters):
            return []
        names = {p.name for p in parameters} - {"dim", "target"}
        return sorted(names | {"loss", "seed", "budget"})

    def recommend(self) -> Float64:
        """What it recommends, (dim,); by default the best, or the center.

        Raises PointsError (a ValueError) if that is no point of the unit cube.
        """
        if self._last_word is not None:
            return self._last_word.copy()
        if not self._recommends or self._best is None:
            return super().recommend()
        with self._called():
            return self._recommended()

    def _recommended(self) -> Float64:
        """The user's recommendation, (dim,), checked."""
        self._tried = True
        said = self._user.recommend()
        try:
            (x,) = as_points([said], self.dim)
        except PointsError as error:
            raise PointsError(
                f"recommend() of {self.name} must return a point of the shape ({self.dim},) in "
                f"[0, 1]: {error}"
            ) from error
        return np.asarray(x)

    def settings(self) -> dict[str, Any]:
        """Arguments of the constructor, by name, but for `loss` and `device`."""
        common = {"dim": self.dim, "target": self.target, "seed": self.seed}
        return {**common, "budget": self.budget, "popsize": self.popsize, "options": self._options}

    @classmethod
    def arguments(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Arguments of the constructor, by name, of what `settings` gave."""
        given = {k: v for k, v in settings.items() if k not in ("popsize", "options")}
        return {**given, **settings["options"]}

    def _sample(self) -> Float64:
        if self._last_word is not None:
            raise CheckpointError(self._cannot_go_on())
        with self._called():
            asked = self._user.ask(self.popsize)
        try:
            X = as_points(asked, self.dim)
            if len(X) != self.popsize:
                raise PointsError(f"X has {len(X)} rows")
        except PointsError as error:
            raise PointsError(
                f"ask({self.popsize}) of {self.name} must return candidates of the shape "
                f"({self.popsize}, {self.dim}) in [0, 1]: {error}"
            ) from error
        self._asked = X
        return X

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        with self._called():
            told: list[Any] = [X, losses]
            if self._images_at is not None:
                told.insert(self._images_at, features)
            self._user.tell(*told)
            if self._recommends and not self._tried and self._best is not None:
                self._recommended()

    def _encode(self, batch: Float32 | None) -> Float32 | None:
        if self._images_at is None:
            return None
        return needed_images(self.name, batch).copy()  # a renderer may use its memory again

    @property
    def _is_finished(self) -> bool:
        return len(self._losses) >= self.budget

    def _cannot_go_on(self) -> str:
        return (
            f"{self.name} learns from images, which a checkpoint does not hold, so it cannot "
            "be resumed; run it again from the beginning, in another directory"
        )

    def _search_state(self) -> dict[str, Any]:
        state = {**super()._search_state(), "asked": self._asked}
        if self._images_at is not None and self._is_finished:  # nothing else of it is needed again
            state["recommended"] = self.recommend()
        return state

    def _load_search_state(self, state: dict[str, Any]) -> None:
        history = dict(state)
        asked, last_word = history.pop("asked"), history.pop("recommended", None)
        check(asked, maybe(array("k", "d", low=0.0, high=1.0)), self._sides(), "asked")
        check(last_word, maybe(array("d", low=0.0, high=1.0)), self._sides(), "recommended")
        if last_word is not None:
            self._keep_history(history)
            self._asked, self._last_word = asked, last_word
            return
        if self._images_at is not None and asked is not None:
            raise CheckpointError(self._cannot_go_on())
        super()._load_search_state(history)
        now, then = self._asked, state["asked"]
        if (now is None) != (then is None) or (now is not None and not np.array_equal(now, then)):
            raise CheckpointError(
                f"{self.name} asks for other candidates when it is run again; draw random numbers "
                "from its seed, or run it again from the beginning, in another directory"
            )


def own(reference: str) -> type[Own]:
    """Class of the user's optimizer ``FILE.py:NAME`` or ``module:NAME``.

    Raises OptionError (a ValueError), with the remedy, if there is none or it breaks the protocol.
    """
    place, name = _REFERENT.split(reference)
    module = _REFERENT.load(place)
    found = _REFERENT.attribute(module, place, name)
    _check_constructor(reference, found)
    if isinstance(found, type):
        _check_methods(reference, found)
    about = {
        "name": reference,
        "made_by": staticmethod(found),
        "source": module_fingerprint(module),
    }
    return type("Own", (Own,), about)


def _check_constructor(reference: str, found: Callable[..., Any]) -> None:
    parameters = inspect.signature(found).parameters.values()
    needed = [p.name for p in parameters if p.default is p.empty and p.kind is not p.VAR_KEYWORD]
    strange = [name for name in needed if name not in _GIVEN]
    if strange or not any(p.name == "dim" for p in parameters):
        what = f"needs {strange[0]!r} too" if strange else "has no dim"
        raise OptionError(
            f"the constructor of {reference} must have a parameter dim, and may have target, seed "
            f"and budget; it {what}: {inspect.signature(found)}; give other parameters a default"
        )


def _check_methods(reference: str, found: Any) -> None:
    """Check `ask` and `tell` of a class or an object; OptionError if they break the protocol."""
    first = (None,) if isinstance(found, type) else ()  # self
    forms = {"ask": "ask(n)", "tell": "tell(X, losses) or tell(X, images, losses)"}
    for name, form in forms.items():
        method = getattr(found, name, None)
        if not callable(method):
            raise OptionError(f"{reference} has no method {name}; give it {form}")
        signature = inspect.signature(method)
        given = 1 if name == "ask" else 3 if "images" in signature.parameters else 2
        try:
            signature.bind(*first, *range(given))
        except TypeError as error:
            raise OptionError(
                f"{name} of {reference} must be {form}, not {name}{signature}: {error}"
            ) from None
