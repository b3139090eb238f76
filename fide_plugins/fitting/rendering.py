"""One render: from a point of the cube to an image, or to what went wrong.

A worker process loads this file, and no PyTorch.
"""

from __future__ import annotations

import pickle
import time
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any, TypeAlias, TypeVar

import numpy as np

from fide_plugins.errors import ImageError, RenderError
from fide_plugins.space import Space
from fide_plugins.types import Float64
from fide_plugins.validation.image_files import read_pixels
from fide_plugins.validation.images import is_path, is_pil

_T = TypeVar("_T")
_BROKEN = (
    NameError, TypeError, AttributeError, ImportError, SyntaxError, NotImplementedError, KeyError,
    OSError, MemoryError,
)  # fmt: skip
"""Errors for which parameters are hardly the reason: a misspelled name, a missing file."""


@dataclass(frozen=True, slots=True, eq=False)
class Rendered:
    """An image as the user's function returned it, or read from its file; seconds: it took."""

    image: Any
    seconds: float
    fineness: Any = None
    """At which it was rendered, see `fitting.fidelity`; None: nobody asked for any."""


@dataclass(frozen=True, slots=True)
class Failed:
    """A render that gave no image.

    reason: in one line.  details: the traceback in the worker, or what else is known.
    names_params: whether they say with which parameters.
    broken: whether other parameters will hardly do better, as far as the kind of error says.
    killed: whether it ended its worker, or was ended for its time.
    """

    reason: str
    details: str = ""
    names_params: bool = False
    broken: bool = False
    killed: bool = False
    fineness: Any = None
    params: Any = None
    """Argument of the user's function, where this is told to the user."""

    def __str__(self) -> str:
        return "\n".join(filter(None, [self.reason, self._call, self.details]))

    @property
    def brief(self) -> str:
        """The same with the last line of a traceback, or of a program's output, only."""
        end = self.details.rpartition("\n")[2].strip()
        told = self.reason if not end or end in self.reason else f"{self.reason}: {end}"
        return "\n".join(filter(None, [told, self._call]))

    @property
    def _call(self) -> str:
        return "" if self.names_params else f"render({self.params})"

    @classmethod
    def by(cls, error: BaseException) -> Failed:
        """What an exception of the user's function says; a RenderError is complete."""
        if isinstance(error, RenderError):
            reason, _, details = str(error).partition("\n")
            inner = error.__context__  # of which the message tells
            broken = isinstance(inner, _BROKEN) or isinstance(
                getattr(inner, "__cause__", None), OSError
            )
            return cls(reason, details, names_params=True, broken=broken)
        lines = traceback.format_exception(type(error), error, _beyond_here(error))
        text = f"{type(error).__name__}: {error}"
        return cls(text, "".join(lines).rstrip(), broken=isinstance(error, _BROKEN))

    @classmethod
    def no_fit(cls, error: ImageError, image: Any) -> Failed:
        """What is wrong with an image; one of NaN says that the parameters are invalid."""
        try:
            finite = bool(np.isfinite(np.asarray(image, np.float64)).all())
        except (TypeError, ValueError, RuntimeError):  # no array at all
            finite = True
        return cls(f"render returned no image that fits: {error}", broken=finite)


Outcome: TypeAlias = Rendered | Failed
Task: TypeAlias = "Future[Outcome]"
"""A render that was begun, or will be as soon as a worker is free."""


class Workers:
    """Renders candidates, `number` at a time; the others of this base stop no render."""

    number: int = 1

    @property
    def usable(self) -> int:
        """How many can render: all but those that hang and cannot be killed."""
        return self.number

    def submit(self, x: Any) -> Task:
        """Render the point x (d,), or whatever the renderer takes."""
        raise NotImplementedError

    def outcome(self, task: Task) -> Outcome:
        """What a task that is done has given, or what went wrong."""
        return task.result()

    def began(self, task: Task) -> float | None:
        """Time of `time.monotonic` when the render began; None if it waits for its worker."""

    def abandon(self, task: Task) -> None:
        """Stop a render that takes too long; where that is impossible, forget it."""

    def close(self) -> None:
        """Stop all renders, and give back what was taken for them."""


def attempt(
    call: Callable[[], _T], describe: Callable[[BaseException], Failed] = Failed.by
) -> _T | Failed:
    """What a call of the user's code returns, or a description of the exception that it raises."""
    try:
        return call()
    except (Exception, SystemExit) as error:  # scripts end by sys.exit
        return describe(error)


@dataclass(frozen=True, slots=True)
class Renderer:
    """The user's function of a dictionary, or of x (d,) where there is no space.

    raw: whether numbers of image files are wanted as they are stored, for a range of values.
    keywords: further arguments of a point that comes without its own, such as the size.
    """

    render: Callable[..., Any]
    space: Space | None
    raw: bool = False
    keywords: Mapping[str, Any] = field(default_factory=dict)

    def params(self, x: Float64) -> Any:
        """Argument of the user's function for a point x (d,)."""
        return x.copy() if self.space is None else self.space.decode(x)

    def __call__(self, x: Any) -> Outcome:
        """Image of the point x (d,) of the cube, or of a pair of it and keyword arguments."""
        start = time.perf_counter()
        point, keywords = x if isinstance(x, tuple) else (x, self.keywords)
        image = attempt(lambda: self._image(point, keywords))
        if isinstance(image, Failed):
            return image
        return Rendered(image, time.perf_counter() - start)

    def _image(self, x: Float64, keywords: Mapping[str, Any]) -> Any:
        image = self.render(self.params(x), **keywords)
        try:
            return _in_memory(image, self.raw)
        except ImageError as error:
            return Failed.no_fit(error, image)


def _in_memory(image: Any, raw: bool) -> Any:
    """The image, or the list of images, with the pixels of those that are still in a file."""
    if isinstance(image, list | tuple) and any(is_path(one) or is_pil(one) for one in image):
        return type(image)(_in_memory(one, raw) for one in image)
    if is_path(image):
        return read_pixels(image, None, raw=raw)
    if is_pil(image):  # of an opened file Pillow has read no pixel yet
        try:
            image.load()
        except Exception as error:  # decoders of untrusted bytes raise nearly anything
            image.close()
            raise ImageError(f"cannot read the image that Pillow has opened: {error}") from error
    return image


@dataclass(frozen=True, slots=True)
class Portable:
    """A renderer for other processes, by value; its images come back as bytes, see `unpack`."""

    payload: bytes

    @classmethod
    def of(cls, renderer: Callable[[Any], Outcome]) -> Portable:
        """Pickle the renderer."""
        import cloudpickle

        return cls(cloudpickle.dumps(renderer))

    def __call__(self, x: Float64) -> Outcome:
        """Image of the point x (d,) of the cube, as bytes."""
        renderer = attempt(partial(restored, self.payload))
        return renderer if isinstance(renderer, Failed) else pack(renderer(x))


@lru_cache(maxsize=4)
def restored(payload: bytes) -> Callable[[Any], Outcome]:
    """Renderer of a `Portable`; once for each process."""
    renderer: Callable[[Any], Outcome] = pickle.loads(payload)
    return renderer


def pack(outcome: Outcome) -> Outcome:
    """The same with its image as bytes: PyTorch would share the memory of a killed worker."""
    if isinstance(outcome, Failed):
        return outcome
    try:
        return replace(outcome, image=pickle.dumps(outcome.image, protocol=5))
    except Exception as error:
        return Failed.by(error)


def unpack(outcome: Outcome) -> Outcome:
    """Undo `pack`, for what a worker has sent."""
    if isinstance(outcome, Rendered) and isinstance(outcome.image, bytes):
        return replace(outcome, image=pickle.loads(outcome.image))
    return outcome


def _beyond_here(error: BaseException) -> Any:
    frames = error.__traceback__
    while frames is not None and frames.tb_next and frames.tb_frame.f_code.co_filename == __file__:
        frames = frames.tb_next
    return frames
