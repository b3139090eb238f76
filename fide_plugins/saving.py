"""`save` and `load` of FIDE and of all baselines."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar, Self

import numpy as np

from fide_plugins import losses
from fide_plugins.errors import CheckpointError, UnknownNameError
from fide_plugins.losses.base import loss_not_stored
from fide_plugins.runtime import checkpoint
from fide_plugins.runtime.schema import IMPOSSIBLE, check, whole
from fide_plugins.runtime.threads import Lock, one_at_a_time, one_thread

_MOST = 2**20  # parameters, and candidates of a generation


class Saved(ABC):
    """An optimizer that is saved as its constructor arguments and its state."""

    _lock: Lock

    name: ClassVar[str]

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """Arguments of the constructor, by name, but for `loss` and `device`, as plain values."""

    @property
    @abstractmethod
    def loss_name(self) -> str | None:
        """Name from which the loss can be made again; None for a user's own callable."""

    @property
    def pretrained(self) -> tuple[str, str] | None:
        """Name of the encoder and digest of its pretrained weights; None if it has none."""
        return None

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """The evolving state, as nested dicts of arrays, tensors and numbers, not copies."""

    @abstractmethod
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where `state_dict` gave `state`, with the same settings; or raise ValueError."""

    @classmethod
    def arguments(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Arguments of the constructor, by name, of what `settings` gave."""
        return dict(settings)

    @classmethod
    def check_settings(cls, settings: Mapping[str, Any]) -> None:
        """Raise ValueError for impossible numbers of parameters or candidates, or no target."""
        for name in ("dim", "popsize"):
            check(settings[name], whole(1, _MOST), {}, name)
        if "target" not in settings:
            raise ValueError("settings lack 'target'")

    @classmethod
    def resolve_loss(cls, loss: Any, settings: Mapping[str, Any], device: str) -> Any:
        """Loss that a user gave for an optimizer of these settings; raises as `losses.resolve`."""
        return losses.resolve(loss, settings["target"], device=device)

    @one_at_a_time
    @one_thread
    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a checkpoint from which `load` continues bit for bit; no pickle; raises OSError."""
        checkpoint.write(path, self.name, self.snapshot())

    @one_at_a_time
    def snapshot(self) -> dict[str, Any]:
        """Input of `restore`: nested dicts of arrays, tensors and numbers, not copies."""
        return {"settings": self.settings(), "loss": self.loss_name, "state": self.state_dict()}

    @classmethod
    def restore(
        cls,
        snapshot: Mapping[str, Any],
        loss: object = None,
        device: str = "auto",
        encoder: object = None,
        constraints: object = None,
    ) -> Self:
        """Optimizer in the state in which `snapshot` was called.

        loss, encoder: None for those named in the snapshot.  constraints: None for none.

        Raises ValueError and other errors if the snapshot is impossible.
        """
        used = loss or snapshot["loss"] or loss_not_stored
        arguments = cls.arguments(snapshot["settings"])
        given = {"encoder": encoder, "constraints": constraints}
        arguments |= {name: value for name, value in given.items() if value is not None}
        optimizer = cls(loss=used, device=device, **arguments)  # type: ignore[call-arg]
        optimizer.load_state_dict(snapshot["state"])
        return optimizer

    @classmethod
    @one_thread
    def load(
        cls,
        path: str | os.PathLike[str],
        *,
        loss: str | Callable[..., object] | None = None,
        device: str = "auto",
        encoder: Callable[..., object] | None = None,
        constraints: Callable[..., object] | None = None,
    ) -> Self:
        """Optimizer in the state that was saved at `path`.

        A checkpoint stores a loss and an encoder only by name: give a callable again as `loss` (or
        tell losses) or `encoder`.  Without a function of constraints, which is not stored, FIDE can
        be read and told, but not asked.

        Raises OSError, CheckpointError (a ValueError) if the file is damaged, of another version,
        or of another optimizer; and the errors of the constructor for a wrong `loss` or `device`.
        """
        saved = checkpoint.read(path, cls.name)
        if device != "auto":
            from fide_plugins.runtime.devices import resolve_device  # PyTorch takes a second

            resolve_device(device)
        with _possible(path):
            settings = saved["settings"]
            cls.check_settings(settings)
        given = None if loss is None else cls.resolve_loss(loss, settings, device)
        with _possible(path):
            return cls.restore(saved, given, device, encoder, constraints)

    @one_at_a_time
    @one_thread
    def continue_from(self, path: str | os.PathLike[str]) -> None:
        """Go on in the state that an optimizer with the same arguments saved at `path`.

        Unlike `load` it needs no names: loss and encoder are those of this optimizer.

        Raises OSError, or CheckpointError (a ValueError) as `load`, or if the arguments were
        others; nothing changes then.
        """
        saved = checkpoint.read(path, self.name)
        with _possible(path):
            stored, own = saved["settings"], self.settings()
            other = [name for name in own if not _same(stored.get(name), own[name])]
            if other:
                raise CheckpointError(
                    f"{os.fspath(path)}: it was saved with another {', '.join(other)}; give the "
                    "same here, or name another checkpoint"
                )
            self.load_state_dict(saved["state"])


def _same(one: Any, other: Any) -> bool:
    """Whether two values of a setting are the same; a tuple comes back from a file as a list."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(_same, one, other))
    return bool(np.array_equal(one, other))


@contextmanager
def _possible(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn errors of this block, which the file causes, into CheckpointError."""
    try:
        yield
    except CheckpointError:  # the optimizer's own, which says what to do
        raise
    except IMPOSSIBLE as error:
        why = f"{os.fspath(path)}: a checkpoint with impossible contents ({error!r})"
        remedy = "start again, or take an earlier copy, or the version of FIDE that wrote it"
        if isinstance(error, UnknownNameError):
            remedy = (
                "give an encoder of your own again, load(path, encoder=...), or register what it "
                "names first (encoders.register, losses.register)"
            )
        raise CheckpointError(f"{why}; {remedy}") from error


def as_arrays(tree: Any) -> Any:
    """Copy of nested dicts, lists and tuples with arrays in place of tensors, from any device.

    Tuples become lists.  A snapshot is pickled in this form.
    """
    if isinstance(tree, dict):
        return {key: as_arrays(value) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        return [as_arrays(value) for value in tree]
    return tree.detach().cpu().numpy() if hasattr(tree, "detach") else tree
