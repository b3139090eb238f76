"""Files from anywhere: damaged, invented, enormous; refused with an error of ours, or harmless."""

from __future__ import annotations

import copy
import io
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from PIL import Image

from fide_lab import run as harness
from fide_plugins.errors import CheckpointError, FideError, ImageError, ProtocolError
from fide_plugins.fide import FIDE
from fide_plugins.recording.storage import read_checkpoint
from fide_plugins.runtime import checkpoint
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.images import as_target

CASES = int(os.environ.get("FIDE_CASES", "1"))  # times as many as in CI
FOLDER = Path(tempfile.mkdtemp())  # for files that a case writes over
TARGET = np.random.default_rng(0).random((2, 2, 3), np.float32)


def images_of(X: Float64) -> Float32:
    images: Float32 = (X[:, :1, None, None] * TARGET).astype(np.float32)
    return images


def saved(**options: Any) -> dict[str, Any]:
    """State of an optimizer that has searched, tested, restarted, and has pending candidates."""
    opt = FIDE(2, TARGET / 2, popsize=4, seed=1, patience=3, guard_images=False, **options)
    for _ in range(30):
        X = opt.ask()
        opt.tell(X, images_of(X))
    opt.ask(2)
    opt.save(FOLDER / "saved")
    return checkpoint.read(FOLDER / "saved", "fide")


STATES = {
    "both": saved(),
    "diffusion": saved(proposer="diffusion", epochs=1, restarts="none"),
}


def places(node: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Of everything in a state."""
    children = (
        node.items() if isinstance(node, dict)
        else enumerate(node) if isinstance(node, list) else ()
    )  # fmt: skip
    for key, child in children:
        yield (*at, key)
        yield from places(child, (*at, key))


def changed(state: Any, place: tuple[Any, ...], value: Any) -> Any:
    """The state with something else at that place, or nothing (`...`); the rest is shared."""
    key, *rest = place
    state = copy.copy(state)
    if rest:
        state[key] = changed(state[key], tuple(rest), value)
    elif value is ...:
        del state[key]
    else:
        state[key] = value
    return state


ODD: list[Any] = [
    ..., None, True, -1, 0, 1, 3, 2**40, 2**70, -(2**70), 0.5, 1e308, -1e300, 5e-324,
    float("nan"), float("inf"), "", "x", [], [1], {}, {"a": 1}, b"x".decode(),
    np.zeros(0), np.zeros(2), np.zeros(3), np.full(2, np.nan), np.full(2, 1e300), np.full(2, -1),
    np.zeros((2, 2)), np.full((2, 2), np.inf), np.zeros((2, 2), np.int64), np.zeros((0, 7)),
    np.zeros(2, bool), np.array("x"), np.zeros((2, 2, 3), np.float32), np.array([], "<U5"),
]  # fmt: skip


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:training of the denoiser diverged:RuntimeWarning")
@settings(max_examples=120 * CASES, deadline=None)
@given(st.sampled_from(sorted(STATES)), st.data(), st.integers(1, 3))
def test_a_checkpoint_of_anything_is_refused_or_goes_on(
    proposer: str, data: st.DataObject, changes: int
) -> None:
    """With a good checksum: what is accepted asks for candidates in the box, and can be told."""
    state = STATES[proposer]
    for _ in range(changes):
        place = data.draw(st.sampled_from(list(places(state))))
        state = changed(state, place, data.draw(st.sampled_from(ODD)))
    refused_or_goes_on(state)


def refused_or_goes_on(state: Any) -> None:
    checkpoint.write(FOLDER / "odd", "fide", state)
    try:
        opt = FIDE.load(FOLDER / "odd")
    except CheckpointError:
        return
    for _ in range(3):
        try:
            X = opt.ask(4)
        except ProtocolError as error:  # as if it had been saved with a function of constraints
            assert "give it again" in str(error)
            return
        assert X.shape == (4, opt.dim) and ((X >= 0) & (X <= 1)).all()
        opt.tell(X, np.full((4, *opt.target.shape), 0.5), X[:, 0])
    assert np.isfinite(opt.recommend()).all()


def damage(data: bytes, kinds: list[tuple[int, int, int]]) -> bytes:
    """Change, insert, remove, double or cut bytes: (kind, where, what)."""
    for kind, where, what in kinds:
        i = where % max(1, len(data))
        data = {
            0: data[:i] + bytes([what % 256]) + data[i + 1 :],
            1: data[:i] + bytes([what % 256]) * (what % 9) + data[i:],
            2: data[:i] + data[i + what % 40 :],
            3: data[:i] + data[i : i + what % 40] * 2 + data[i + what % 40 :],
            4: data[:i],
        }[kind]
    return data


damages = st.lists(
    st.tuples(st.sampled_from([0, 0, 0, 1, 2, 3, 4]), st.integers(0, 10**6), st.integers(0, 999)),
    min_size=1,
    max_size=4,
)


class Gray:
    """A task."""

    name, dim, target = "gray", 2, TARGET / 2

    def render(self, X: Float64, seed: Any = None) -> Float32:
        return images_of(X)


def a_run(out: Path, resume: bool = True) -> harness.Run:
    return harness.prepare(
        Gray(), "fide", "mse", 30, 0, out=out, resume=resume, options={"popsize": 4},
        checkpoint_every=0, keep=harness.Keep(summary=False),
    )  # fmt: skip


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    a_run(folder).execute()
    return folder


@pytest.mark.thorough
@settings(max_examples=60 * CASES, deadline=None)
@given(st.data())
def test_a_run_directory_of_anything_is_refused_or_goes_on(
    run_folder: Path, data: st.DataObject
) -> None:
    before = {path.name: path.read_bytes() for path in run_folder.iterdir()}
    state = checkpoint.read(run_folder / "run.ckpt", "run")
    run = json.loads(before["run.json"])
    try:
        if data.draw(st.booleans()):
            place = data.draw(st.sampled_from(list(places(state))))
            odd = changed(state, place, data.draw(st.sampled_from(ODD)))
            checkpoint.write(run_folder / "run.ckpt", "run", odd)
        else:
            place = data.draw(st.sampled_from(list(places(run))))
            odd = changed(run, place, data.draw(st.sampled_from([*ODD[:3], 2**70, "x", [], {}])))
            (run_folder / "run.json").write_text(json.dumps(odd))
        with suppress(FideError, OSError):
            a_run(run_folder).execute()
    finally:
        for path in run_folder.iterdir():
            path.unlink()
        for name, content in before.items():
            (run_folder / name).write_bytes(content)


@pytest.mark.parametrize("name", ["../secret", "/etc/passwd", "a/b", "", ".", "..", "a\0b"])
def test_no_path_leads_out_of_a_run_directory(name: str, run_folder: Path, tmp_path: Path) -> None:
    state = checkpoint.read(run_folder / "run.ckpt", "run")
    for path in run_folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    checkpoint.write(tmp_path / "run.ckpt", "run", {**state, "optimizer": name})
    with pytest.raises((CheckpointError, OSError)):
        a_run(tmp_path)
    with pytest.raises(CheckpointError, match="names no optimizer's file"):
        read_checkpoint(tmp_path)


PICTURES = {}
for _kind in ("PNG", "JPEG", "GIF", "TIFF", "BMP", "WEBP", "PPM", "ICO", "TGA"):
    _stream = io.BytesIO()
    Image.fromarray(np.arange(12 * 16 * 3, dtype=np.uint8).reshape(12, 16, 3)).save(_stream, _kind)
    PICTURES[_kind] = _stream.getvalue()


@pytest.mark.filterwarnings("ignore")  # Pillow's remarks on damaged files
@settings(max_examples=150 * CASES, deadline=None)
@given(st.sampled_from(sorted(PICTURES)), damages)
def test_a_damaged_picture_is_a_picture_or_refused(
    kind: str, kinds: list[tuple[int, int, int]]
) -> None:
    (FOLDER / "picture").write_bytes(damage(PICTURES[kind], kinds))
    try:
        image = as_target(FOLDER / "picture")
    except ImageError:
        return
    assert image.dtype == np.float32 and image.ndim == 3 and image.shape[2] == 3
    assert image.min() >= 0 and image.max() <= 1
