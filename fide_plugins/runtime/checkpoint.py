"""File format of a state, exact to the last bit, without pickle.

A state is a nested dict or list of arrays (NumPy; PyTorch tensors come back as NumPy), int, float,
str, bool and None.  The file is

    magic (8 bytes) | version (u32) | length of body (u64) | BLAKE2b of body (32) | body

in little endian.  The body is the length (u64) of a JSON tree, that tree, and the raw bytes of all
arrays, each at an offset divisible by 64.  Floats are stored as their 16 hexadecimal digits, and
integers have no limit.  The file may come from anybody: nothing in it is executed, and every
length, shape and offset is checked against the size of the file before memory is allocated.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import struct
import sys
from typing import Any, NoReturn

import numpy as np

from fide_plugins.errors import CheckpointError

from .files import RefusedFileError, atomic_writer, open_regular
from .schema import IMPOSSIBLE

__all__ = ["VERSION", "VERSION_REMEDY", "read", "write"]

VERSION = 5
VERSION_REMEDY = "take the version of FIDE, and the weights, that wrote it"
"""What helps against a state whose features or losses are of another version."""
_MAGIC = b"\x89FIDE\r\n\x1a"
_HEADER = struct.Struct("<8sIQ32s")
_LENGTH = struct.Struct("<Q")
_ALIGNMENT = 64
_DTYPE = re.compile(r"[<>|][biufc][0-9]{1,2}|[<>]U[0-9]{1,9}|\|S[0-9]{1,9}")


def write(path: str | os.PathLike[str], kind: str, state: dict[str, Any]) -> None:
    """Write `state` to `path` atomically, marked as a checkpoint of this `kind`.

    Raises, before an existing file changes, TypeError that names the place in the state of a value
    of another type; OSError if the file cannot be written.
    """
    arrays: list[np.ndarray[Any, Any]] = []
    tree = {"kind": kind, "state": _encode(state, "state", arrays)}
    tree["arrays"] = [[a.dtype.str, list(a.shape)] for a in arrays]
    text = json.dumps(tree, separators=(",", ":")).encode()
    parts: list[bytes | memoryview] = [_LENGTH.pack(len(text)), text]
    position = _LENGTH.size + len(text)
    for array in arrays:
        padding = -position % _ALIGNMENT
        raw = array.reshape(-1).view(np.uint8).data if array.nbytes else b""  # without a copy
        parts += [bytes(padding), raw]
        position += padding + array.nbytes
    digest = hashlib.blake2b(digest_size=32)
    for part in parts:
        digest.update(part)
    with atomic_writer(path) as file:
        file.write(_HEADER.pack(_MAGIC, VERSION, position, digest.digest()))
        for part in parts:
            file.write(part)


def read(path: str | os.PathLike[str], kind: str) -> dict[str, Any]:
    """Read the state that :func:`write` stored at `path` as a checkpoint of this `kind`.

    Raises OSError if the file is missing, and CheckpointError (a ValueError) if it is not a
    checkpoint, is truncated or damaged, or is of another version or kind.
    """
    name = os.fspath(path)
    try:
        body = _body(name)
    except RefusedFileError as error:
        raise CheckpointError(f"{error} that `save` wrote") from None
    try:
        (length,) = _LENGTH.unpack_from(body)
        if length > len(body) - _LENGTH.size:
            _refuse(name, "its table of contents is longer than the file")
        tree = json.loads(bytes(body[_LENGTH.size : _LENGTH.size + length]))
        if tree["kind"] != kind:
            _refuse(name, f"it holds a {tree['kind']!r}, not a {kind!r}", "load it with that class")
        arrays = _arrays(name, body, _LENGTH.size + length, tree["arrays"])
        state = _decode(tree["state"], arrays)
    except (CheckpointError, MemoryError):
        raise
    except (*IMPOSSIBLE, struct.error) as error:
        raise CheckpointError(f"{name}: a checkpoint with impossible contents ({error})") from error
    if not isinstance(state, dict):
        _refuse(name, f"its state is a {type(state).__name__}, not a dict")
    return state


def _refuse(name: str, why: str, remedy: str = "start again, or use an earlier copy") -> NoReturn:
    raise CheckpointError(f"{name}: cannot load this checkpoint: {why}; {remedy}")


def _body(name: str) -> memoryview:
    """Body of the file, after checks of magic, version, length and checksum."""
    with open_regular(name) as file:
        header, size = file.read(_HEADER.size), os.fstat(file.fileno()).st_size - _HEADER.size
        if header[: len(_MAGIC)] != _MAGIC[: len(header)]:
            _refuse(name, "it is not a FIDE checkpoint", "name a file that `save` wrote")
        if len(header) < _HEADER.size:
            _refuse(name, f"it was cut short after {len(header)} bytes")
        _, version, length, checksum = _HEADER.unpack(header)
        if version != VERSION:
            remedy = "load it with the version of the library that wrote it"
            _refuse(name, f"its format is version {version} and this is {VERSION}", remedy)
        if size < length:
            _refuse(name, f"it was cut short: {size} of {length} bytes are there")
        if size > length:
            _refuse(name, f"{size - length} bytes follow its end")
        body = memoryview(file.read(length))
    if hashlib.blake2b(body, digest_size=32).digest() != checksum:
        _refuse(name, "its checksum is wrong, so some of its bytes were changed")
    return body


def _arrays(
    name: str, body: memoryview, position: int, table: list[list[Any]]
) -> list[np.ndarray[Any, Any]]:
    """Copies of the arrays that `table` ([dtype, shape] each) describes, from `position` on."""
    arrays = []
    for dtype_name, shape in table:
        if not isinstance(dtype_name, str) or not _DTYPE.fullmatch(dtype_name):
            _refuse(name, f"an array has the type {dtype_name!r}")
        if not all(type(n) is int and n >= 0 for n in shape) or len(shape) > 32:
            _refuse(name, f"an array has the shape {shape!r}")
        dtype = np.dtype(dtype_name)
        count = math.prod(shape)
        position += -position % _ALIGNMENT
        if count * dtype.itemsize > len(body) - position:
            _refuse(name, f"an array of shape {shape!r} is larger than the file")
        flat = np.frombuffer(body, dtype, count, position) if count else np.empty(0, dtype)
        arrays.append(flat.reshape(shape).copy())
        position += count * dtype.itemsize
    if position != len(body):
        _refuse(name, "its arrays do not fill the file")
    return arrays


def _encode(value: Any, place: str, arrays: list[np.ndarray[Any, Any]]) -> Any:
    """`value` as JSON; arrays are appended to `arrays` and represented by their index.

    None, bool, str and 64-bit ints represent themselves; everything else is a tagged list.
    """
    if isinstance(value, np.generic):
        value = value.item()  # which is no number where NumPy's has no counterpart
    if value is None or isinstance(value, bool | str):
        return str(value) if isinstance(value, str) else value
    if isinstance(value, int):
        return int(value) if -(2**63) <= value < 2**63 else ["i", hex(value)]
    if isinstance(value, float):
        return ["f", struct.pack(">d", value).hex()]
    if isinstance(value, dict):
        for key in value:
            if not isinstance(key, str):
                raise TypeError(f"{place}: a key of a checkpoint is a str, not {key!r}")
        items = {str(k): _encode(v, f"{place}[{k!r}]", arrays) for k, v in value.items()}
        return ["d", items]
    if isinstance(value, list | tuple):
        return ["l", [_encode(v, f"{place}[{i}]", arrays) for i, v in enumerate(value)]]
    arrays.append(_array(value, place))
    return ["a", len(arrays) - 1]


def _array(value: Any, place: str) -> np.ndarray[Any, Any]:
    """`value`, an array or a tensor, as a C-contiguous array on this machine."""
    torch = sys.modules.get("torch")  # imported if the value is a tensor
    if torch is not None and isinstance(value, torch.Tensor):
        try:
            value = value.detach().cpu().numpy()
        except TypeError as error:
            raise TypeError(f"{place}: a checkpoint cannot hold a tensor: {error}") from error
    if not isinstance(value, np.ndarray) or isinstance(value, np.ma.MaskedArray):
        raise TypeError(
            f"{place}: a checkpoint holds arrays, tensors, int, float, str, bool, None, dict and "
            f"list, not {type(value).__name__}"
        )
    if not _DTYPE.fullmatch(value.dtype.str):
        raise TypeError(f"{place}: a checkpoint cannot hold an array of type {value.dtype}")
    return np.asarray(value, order="C")


def _decode(node: Any, arrays: list[np.ndarray[Any, Any]]) -> Any:
    """Inverse of :func:`_encode`."""
    if node is None or isinstance(node, bool | int | str):
        return node
    tag, content = node
    match tag:
        case "f":
            (number,) = struct.unpack(">d", bytes.fromhex(content))
            return number
        case "i":
            return int(content, 16)
        case "d":
            return {key: _decode(child, arrays) for key, child in content.items()}
        case "l":
            return [_decode(child, arrays) for child in content]
        case "a" if type(content) is int and content >= 0:
            return arrays[content]
    raise ValueError(f"unknown entry {tag!r}")
