"""Training that goes on from its checkpoint, where one call was interrupted or the next asks more.

A checkpoint belongs to a plan: renders, passes, and all else that the result depends on.  A plan of
more passes goes on, to the end of the longer schedule; any other one begins again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fide_plugins.errors import CheckpointError
from fide_plugins.learning.training.one_training import Progress, Training
from fide_plugins.runtime import checkpoint
from fide_plugins.runtime.devices import is_out_of_memory
from fide_plugins.runtime.schema import IMPOSSIBLE

__all__ = ["Resumable"]

_KIND = "training"
_REMEDY = "delete this file, and it is trained again; the renders are kept"


@dataclass(frozen=True)
class Resumable:
    """A training of `plan`, kept in `file`."""

    file: Path
    plan: dict[str, Any]

    def run(
        self, training: Training, on_pass: Callable[[Progress], None], *, over: bool = False
    ) -> None:
        """Train from the checkpoint, if it is of this plan, and keep it up to date.

        over: whether a training that was over stays so, also where there is more time now.

        Raises CheckpointError for a damaged file, OSError if it cannot be written.
        """

        def save(state: dict[str, Any]) -> None:
            checkpoint.write(self.file, _KIND, {"plan": self.plan, "state": state})

        saved = self._saved()
        if saved is not None:
            self._restore(training, saved, over)
        else:
            save(training.state_dict())  # the first pass may be interrupted, too
        training.run(on_pass, save)

    @property
    def interrupted(self) -> bool:
        """Whether a training of this very plan has begun and is not over."""
        saved = self._saved()
        if saved is None or saved["plan"]["passes"] != self.plan["passes"]:
            return False
        state = saved.get("state")
        return isinstance(state, dict) and not state.get("over", True)

    def _saved(self) -> dict[str, Any] | None:
        """Contents of the file; None where it is missing, or another plan's of no use here.

        Raises CheckpointError for a damaged file.
        """
        if not self.file.exists():
            return None
        try:
            saved = checkpoint.read(self.file, _KIND)
        except CheckpointError as error:
            raise CheckpointError(f"{self.file}: damaged, or no training; {_REMEDY}") from error
        there = saved.get("plan", {})
        passes = there.get("passes")
        if not isinstance(passes, int) or passes > self.plan["passes"]:
            return None
        return saved if {**there, "passes": self.plan["passes"]} == self.plan else None

    def _restore(self, training: Training, saved: dict[str, Any], over: bool) -> None:
        passes = saved["plan"]["passes"]
        try:
            training.load_state_dict(saved["state"])
            was_over = saved["state"]["over"]
            if was_over and over:
                training.seconds = 0.0
            longer = self.plan["passes"] > passes
            training.extended |= was_over and (longer or not training.over)
        except IMPOSSIBLE as error:
            if is_out_of_memory(error):
                raise
            raise CheckpointError(
                f"{self.file}: impossible contents ({error!r}); {_REMEDY}"
            ) from error
