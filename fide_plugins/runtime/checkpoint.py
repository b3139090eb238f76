"""File format of a state, exact to the last bit, without pickle; the file may be anybody's.

A state is a nested dict or list of arrays, int, float, str, bool and None.  Little endian:
magic (8 bytes) | version (u32) | BLAKE2b of the rest (32) | length of JSON | JSON | arrays
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import struct
from typing import Any, NoReturn

import numpy as np

from fide_plugins.errors import CheckpointError

from .files import RefusedFileError, atomic_writer, open_regular
from .schema import IMPOSSIBLE

__all__ = ["VERSION", "VERSION_REMEDY", "read", "write"]

VERSION = 8
VERSION_REMEDY = "take the version of FIDE, and the weights, that wrote it"
"""What helps against a state whose features or losses are of another version."""
_MAGIC = b"\x89FIDE\r\n\x1a"
_HEADER = struct.Struct("<8sI32s")
_LENGTH = struct.Struct("<Q")
_ARRAY = "FIDE array"
_DTYPE = re.compile(r"[<>|][biufc][0-9]{1,2}|[<>]U[0-9]{1,9}")


def write(path: str | os.PathLike[str], kind: str, state: dict[str, Any]) -> None:
    """Write `state` to `path` atomically, marked as a checkpoint of this `kind`.

    Raises, before an existing file changes, TypeError for a value of another type; OSError if the
    file cannot be written.
    """
    arrays: list[np.ndarray[Any, Any]] = []

    def stored(value: Any) -> Any:
        if isinstance(value, np.generic):
            return value.item()
        arrays.append(_array(value))
        return {_ARRAY: len(arrays) - 1}

    tree = json.dumps(state, default=stored, separators=(",", ":"))
    table = json.dumps([[a.dtype.str, list(a.shape)] for a in arrays])
    text = f'{{"kind":{json.dumps(kind)},"arrays":{table},"state":{tree}}}'.encode()
    parts: list[Any] = [_LENGTH.pack(len(text)), text]
    parts += [a.reshape(-1).view(np.uint8).data for a in arrays if a.nbytes]  # without a copy
    digest = hashlib.blake2b(digest_size=32)
    for part in parts:
        digest.update(part)
    with atomic_writer(path) as file:
        file.write(_HEADER.pack(_MAGIC, VERSION, digest.digest()))
        for part in parts:
            file.write(part)


def read(path: str | os.PathLike[str], kind: str) -> dict[str, Any]:
    """Read the state that :func:`write` stored at `path` as a checkpoint of this `kind`.

    Raises OSError if the file is missing, and CheckpointError (a ValueError) if it is not a
    checkpoint, is truncated or damaged, or is of another version or kind.
    """
    name = os.fspath(path)
    try:
        with open_regular(name) as file:
            data = memoryview(file.read())
    except RefusedFileError as error:
        raise CheckpointError(f"{error} that `save` wrote") from None
    body = data[_HEADER.size :]
    if data[: len(_MAGIC)] != _MAGIC:
        _refuse(name, "it is not a FIDE checkpoint", "name a file that `save` wrote")
    _, version, checksum = _HEADER.unpack(data[: _HEADER.size].tobytes().ljust(_HEADER.size, b"\0"))
    if body and version != VERSION:
        remedy = "load it with the version of the library that wrote it"
        _refuse(name, f"its format is version {version} and this is {VERSION}", remedy)
    if hashlib.blake2b(body, digest_size=32).digest() != checksum:
        _refuse(name, "its checksum is wrong: it was cut short, or some of its bytes were changed")
    try:
        start = _LENGTH.size + _LENGTH.unpack_from(body)[0]
        tree = json.loads(bytes(body[_LENGTH.size : start]))
        if tree["kind"] != kind:
            _refuse(name, f"it holds a {tree['kind']!r}, not a {kind!r}", "load it with that class")
        state = _filled(tree["state"], _arrays(body[start:], tree["arrays"]))
        if not isinstance(state, dict):
            _refuse(name, f"its state is a {type(state).__name__}, not a dict")
    except (CheckpointError, MemoryError):
        raise
    except (*IMPOSSIBLE, struct.error) as error:
        raise CheckpointError(f"{name}: a checkpoint with impossible contents ({error})") from error
    return state


def _refuse(name: str, why: str, remedy: str = "start again, or use an earlier copy") -> NoReturn:
    raise CheckpointError(f"{name}: cannot load this checkpoint: {why}; {remedy}")


def _array(value: Any) -> np.ndarray[Any, Any]:
    """`value`, an array or a tensor, as a C-contiguous array on this machine."""
    array = value.detach().cpu().numpy() if hasattr(value, "detach") else value
    if not isinstance(array, np.ndarray) or not _DTYPE.fullmatch(array.dtype.str):
        what = f"an array of type {array.dtype}" if hasattr(array, "dtype") else repr(value)
        raise TypeError(
            "a checkpoint holds arrays of numbers, tensors, int, float, str, bool, None, dict and "
            f"list, not {what}"
        )
    return np.asarray(array, order="C")


def _arrays(data: memoryview, table: list[list[Any]]) -> list[np.ndarray[Any, Any]]:
    """Copies of the arrays that `table` ([dtype, shape] each) describes, one after the other."""
    arrays, position = [], 0
    for name, shape in table:
        if not _DTYPE.fullmatch(name) or not all(type(n) is int and n >= 0 for n in shape):
            raise ValueError(f"an array of type {name!r} and shape {shape!r}")
        end = position + math.prod(shape) * np.dtype(name).itemsize
        if end > len(data):
            raise ValueError(f"an array of shape {shape!r} is larger than the file")
        flat: Any = np.frombuffer(bytearray(data[position:end]), name) if end > position else []
        arrays.append(np.asarray(flat, name).reshape(shape))
        position = end
    if position != len(data):
        raise ValueError("the arrays do not fill the file")
    return arrays


def _filled(node: Any, arrays: list[np.ndarray[Any, Any]]) -> Any:
    """`node` with its arrays in place of their numbers."""
    if isinstance(node, list):
        return [_filled(child, arrays) for child in node]
    if not isinstance(node, dict):
        return node
    if node.keys() == {_ARRAY}:
        return arrays[range(len(arrays))[node[_ARRAY]]]
    return {key: _filled(child, arrays) for key, child in node.items()}
