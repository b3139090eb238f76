"""Checkpoints: every bit back, every damage noticed, nothing executed."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from fide_plugins.errors import CheckpointError
from fide_plugins.runtime import checkpoint

KIND = "test"


def roundtrip(path: Path, state: dict[str, Any]) -> dict[str, Any]:
    checkpoint.write(path, KIND, state)
    return checkpoint.read(path, KIND)


def same(a: Any, b: Any) -> bool:
    """Equal to the last bit, types included."""
    if isinstance(a, np.ndarray):
        return (
            isinstance(b, np.ndarray)
            and a.dtype.str == b.dtype.str
            and a.shape == b.shape
            and a.tobytes() == b.tobytes()
        )
    if isinstance(a, float):
        nans = type(b) is float and a != a and b != b
        return nans or (type(b) is float and struct.pack("d", a) == struct.pack("d", b))
    if isinstance(a, dict):
        return isinstance(b, dict) and list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and bool(a == b)


arrays = hnp.arrays(
    dtype=st.one_of(
        hnp.floating_dtypes(endianness="="),
        hnp.floating_dtypes(endianness=">"),
        hnp.integer_dtypes(),
        hnp.unsigned_integer_dtypes(),
        hnp.boolean_dtypes(),
        hnp.complex_number_dtypes(),
        hnp.unicode_string_dtypes(max_len=5),
    ),
    shape=hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4),
)
leaves = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(allow_nan=True), st.text(), arrays
)
trees = st.recursive(
    leaves,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


@settings(
    max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.dictionaries(st.text(), trees, max_size=4))
def test_any_state_comes_back_bit_for_bit(tmp_path: Path, state: dict[str, Any]) -> None:
    assert same(state, roundtrip(tmp_path / "c", state))


def test_tensors_and_numpy_scalars(tmp_path: Path) -> None:
    weight = torch.nn.Linear(3, 2).weight
    back = roundtrip(
        tmp_path / "c",
        {"w": weight, "n": np.int64(7), "x": np.float64(0.1), "b": np.bool_(True), "t": (1, 2)},
    )
    assert same(back["w"], weight.detach().numpy())
    assert same([back["n"], back["x"], back["b"], back["t"]], [7, 0.1, True, [1, 2]])


def example(path: Path) -> bytes:
    state = {"x": np.arange(30.0), "name": "λ", "f": 0.1, "i": 2**70, "l": [None, np.eye(3)]}
    checkpoint.write(path, KIND, state)
    return path.read_bytes()


def test_damage_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "c"
    data = example(path)
    for position in range(len(data)):
        flipped = bytearray(data)
        flipped[position] ^= 1 << (position % 8)
        for damaged in (flipped, data[:position]):
            path.write_bytes(damaged)
            with pytest.raises(CheckpointError):
                checkpoint.read(path, KIND)
    path.write_bytes(data + b"x")
    with pytest.raises(CheckpointError, match="cut short, or some of its bytes were changed"):
        checkpoint.read(path, KIND)


def test_other_kind_version_and_format_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "c"
    example(path)
    with pytest.raises(CheckpointError, match="holds a 'test', not a 'other'"):
        checkpoint.read(path, "other")
    with monkeypatch.context() as patch:
        written = checkpoint.VERSION
        patch.setattr(checkpoint, "VERSION", written + 1)
        with pytest.raises(CheckpointError, match=f"version {written} and this is {written + 1};"):
            checkpoint.read(path, KIND)
    for foreign in (pickle.dumps([1, 2, 3]), b"PK\x03\x04" + bytes(99), b"{}"):
        path.write_bytes(foreign)
        with pytest.raises(CheckpointError, match="not a FIDE checkpoint"):
            checkpoint.read(path, KIND)


def forged(path: Path, tree: Any, blob: bytes = b"") -> None:
    """Write a file with a right checksum and any contents."""
    text = json.dumps(tree).encode()
    body = struct.pack("<Q", len(text)) + text + blob
    digest = hashlib.blake2b(body, digest_size=32).digest()
    path.write_bytes(struct.pack("<8sI32s", b"\x89FIDE\r\n\x1a", checkpoint.VERSION, digest) + body)


@pytest.mark.parametrize("state", [5, [], {"s": {"FIDE array": 7}}, {"s": {"FIDE array": "x"}}])
def test_impossible_trees_are_refused(tmp_path: Path, state: Any) -> None:
    forged(tmp_path / "c", {"kind": KIND, "arrays": [], "state": state})
    with pytest.raises(CheckpointError):
        checkpoint.read(tmp_path / "c", KIND)


@pytest.mark.parametrize(
    "entry",
    [
        ["|O8", [1]],
        ["<f8", [10**15]],
        ["<f8", [2**40, 2**40]],
        ["<f8", [-1]],
        ["<f8", ["1"]],
        ["<f8", [0, 10**30]],
        ["<f8", [1] * 99],
        ["<f7", [1]],
        ["<M8[s]", [1]],
        [["<f8"], [1]],
        [None, None],
        ["<f8"],
        3,
    ],
)
def test_arrays_that_cannot_be_are_refused_without_allocating(tmp_path: Path, entry: Any) -> None:
    forged(tmp_path / "c", {"kind": KIND, "arrays": [entry], "state": {}}, bytes(64))
    with pytest.raises(CheckpointError):
        checkpoint.read(tmp_path / "c", KIND)


@pytest.mark.parametrize(
    "value",
    [{1, 2}, np.array([None]), object(), 1j, torch.zeros(2, dtype=torch.bfloat16)],
)
def test_what_cannot_be_stored_is_refused_and_the_old_file_stays(
    tmp_path: Path, value: object
) -> None:
    path = tmp_path / "c"
    before = example(path)
    with pytest.raises(TypeError):
        checkpoint.write(path, KIND, {"a": [0, value]})
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["c"]
