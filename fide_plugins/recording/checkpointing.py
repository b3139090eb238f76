"""When to write the next checkpoint: by time, and by how long writing takes; and where it fails."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import perf_counter

from fide_plugins.types import Optimizer

__all__ = ["CheckpointTimer", "note_unsaved", "try_each"]

_INTERVAL = 20  # least time between two checkpoints, in times of writing one


class CheckpointTimer:
    """Says when the next checkpoint is due; it counts from when it is made.

    every: seconds between checkpoints, at least twenty times the time to write one; 0: a checkpoint
        is always due.
    """

    def __init__(self, every: float) -> None:
        self.every = every
        self._written_at, self._writing_took = perf_counter(), 0.0

    def due(self, optimizer: Optimizer) -> bool:
        """Whether the last checkpoint is old enough, in seconds and in times of writing one.

        Not while the optimizer trains, for saving would wait, unless one is always due.
        """
        if self.every <= 0:
            return True
        if optimizer.training:
            return False
        since = perf_counter() - self._written_at
        return since >= max(self.every, _INTERVAL * self._writing_took)

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Around the writing of a checkpoint, which does not count where it raises."""
        start = perf_counter()
        yield
        self._written_at = perf_counter()
        self._writing_took = self._written_at - start


def note_unsaved(error: BaseException, unsaved: Exception) -> None:
    """Add to the error that ends a run, which matters more, that saving failed after it."""
    error.add_note(f"not everything could be written, perhaps no checkpoint: {unsaved}")


def try_each(*writes: Callable[[], object]) -> None:
    """Call all of them, also after one that fails; then raise the first error of them.

    A disk that has no room for a checkpoint has some for a table.
    """
    first: Exception | None = None
    for write in writes:
        try:
            write()
        except Exception as error:
            if first is None:
                first = error
            elif str(error) != str(first):
                first.add_note(f"nor was this written: {error}")
    if first is not None:
        raise first
