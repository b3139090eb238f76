"""An optimizer of the user: ``FILE.py:NAME``, ``module:NAME``, or a class, with ask and tell.

    class Search:
        def __init__(self, dim, seed=None): ...     # of dim, target, seed, budget: those it names
        def ask(self, n): ...                       # (n, dim) in [0, 1]
        def tell(self, X, losses): ...              # or tell(self, X, images, losses)

The other parameters of the constructor are its options.  Two more attributes are optional:
`popsize`, the n that it is asked for, by default 4 + 3 ln dim; and `recommend()`, a point (dim,),
by default the best, which is tried once after the first generation.

`tell` gets all points (n, dim) of one `ask`, as they were asked; the images (n, H, W, 3), float32
in [0, 1]; and the losses (n,), infinite where a loss was NaN.  A generation that the budget cuts
short is not told.  NumPy's and Python's global generators are seeded for it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np

from fide_lab.baselines.base import Baseline, needed_images
from fide_lab.baselines.libraries import GlobalRandom
from fide_plugins.errors import OptionError, PointsError
from fide_plugins.runtime.registry import Referent, module_fingerprint, shown_traceback
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.points import as_points, whole_number

_REFERENT = Referent(
    "optimizer",
    "a class with ask and tell",
    "write FILE.py:NAME or module:NAME, such as mine.py:Search; nevergrad:NAME, optuna:NAME; or a "
    "name of: fide list optimizers",
)
_GIVEN = ("dim", "target", "seed", "budget")  # arguments of the constructor


class Own(Baseline):
    """A user's optimizer with all that a baseline has; `own` makes the class.

    budget: evaluations that are planned.  options: of the user's constructor.
    source: fingerprint of the file that `made_by`, the user's class, was loaded from.

    One that takes images cannot be resumed, since a checkpoint does not hold them.

    Raises OptionError (a ValueError), with the traceback, if the constructor raises an exception,
    or if what it makes breaks the protocol.
    """

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
        try:
            with self._global_random.lent(silent=False):
                self._user: Any = self.made_by(**given, **options)
        except Exception as error:
            raise OptionError(
                f"{self.name} cannot be made; mend this error in it:\n"
                f"{shown_traceback(error, __file__)}"
            ) from None  # the message has its traceback
        _check_methods(self.name, self._user)
        self.popsize = whole_number("popsize", getattr(self._user, "popsize", self.popsize), 1)
        names = list(inspect.signature(self._user.tell).parameters)
        self._images_at = names.index("images") if "images" in names else None
        self.resumable = self._images_at is None
        self._recommends, self._tried = callable(getattr(self._user, "recommend", None)), False

    @contextmanager
    def _called(self) -> Iterator[None]:
        """Around the user's methods; an OSError would be taken for one of the run directory."""
        try:
            with self._global_random.lent(silent=False):
                yield
        except OSError as error:
            raise RuntimeError(f"{self.name} raised {error!r}") from error

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
        if not self._recommends or self._best is None:
            return super().recommend()
        self._tried = True
        with self._called():
            said = self._user.recommend()
        point = self._checked([said], 1, "recommend()", f"a point of shape ({self.dim},)")
        return np.asarray(point[0])

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
        n = self.popsize
        with self._called():
            asked = self._user.ask(n)
        return self._checked(asked, n, f"ask({n})", f"candidates of shape ({n}, {self.dim})")

    def _checked(self, given: Any, n: int, method: str, what: str) -> Float64:
        """Points (n, dim) that a method of the user's returned."""
        try:
            X = as_points(given, self.dim)
            if len(X) != n:
                raise PointsError(f"X has {len(X)} rows")
        except PointsError as error:
            rule = f"{method} of {self.name} must return {what} in [0, 1]"
            raise PointsError(f"{rule}: {error}") from error
        return X

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        told: list[Any] = [X, losses]
        if self._images_at is not None:
            told.insert(self._images_at, features)
        with self._called():
            self._user.tell(*told)
        if not self._tried:
            self.recommend()

    def _encode(self, batch: Float32 | None) -> Float32 | None:
        if self._images_at is None:
            return None
        return needed_images(self.name, batch).copy()  # a renderer may use its memory again


def own(optimizer: str | type) -> type[Own]:
    """Class of the user's optimizer ``FILE.py:NAME`` or ``module:NAME``, or of a class.

    Raises OptionError (a ValueError), with the remedy, if there is none or it breaks the protocol.
    """
    if isinstance(optimizer, str):
        place, name = _REFERENT.split(optimizer)
        module = _REFERENT.load(place)
        found, source = _REFERENT.attribute(module, place, name), module_fingerprint(module)
    else:
        found, source = optimizer, None
    name = optimizer if isinstance(optimizer, str) else optimizer.__name__
    parameters = inspect.signature(found).parameters
    needed = [p for p in parameters.values() if p.default is p.empty]
    strange = [p.name for p in needed if p.kind is not p.VAR_KEYWORD and p.name not in _GIVEN]
    if strange or "dim" not in parameters:
        what = f"needs {strange[0]!r} too" if strange else "has no dim"
        raise OptionError(
            f"the constructor of {name} must have a parameter dim, and may have target, seed "
            f"and budget; it {what}: {inspect.signature(found)}; give other parameters a default"
        )
    if isinstance(found, type):  # before anything is rendered
        _check_methods(name, found)
    return type("Own", (Own,), {"name": name, "made_by": staticmethod(found), "source": source})


def _check_methods(optimizer: str, found: Any) -> None:
    """Raise OptionError if `ask` and `tell` of a class or an object break the protocol."""
    first = (None,) if isinstance(found, type) else ()  # self
    forms = {"ask": "ask(n)", "tell": "tell(X, losses) or tell(X, images, losses)"}
    for name, form in forms.items():
        method = getattr(found, name, None)
        if not callable(method):
            raise OptionError(f"{optimizer} has no method {name}; give it {form}")
        signature = inspect.signature(method)
        given = 1 if name == "ask" else 3 if "images" in signature.parameters else 2
        try:
            signature.bind(*first, *range(given))
        except TypeError as error:
            wrong = f"{name}{signature}: {error}"
            raise OptionError(f"{name} of {optimizer} must be {form}, not {wrong}") from None
