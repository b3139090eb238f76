"""A few hundred malformed files of each kind, made from a sound one: the documented error, or none.

Mutant n is made of the random numbers of seed n, so that one that escapes is found again.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import random
import re
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins import Float, Group, Space
from fide_plugins.errors import CheckpointError, ImageError
from fide_plugins.learning.emulator import Emulator
from fide_plugins.learning.judging import Familiarity, Report
from fide_plugins.learning.model import Model
from fide_plugins.learning.networks import Network
from fide_plugins.recording.storage import RunDirectoryError, read_run
from fide_plugins.runtime import checkpoint, files
from fide_plugins.validation.images import as_target

NUMBER = 300


def mutant_of_json(sound: bytes, seed: int) -> bytes:
    """Valid JSON with one to three changes: something in it replaced, or left out."""
    rng, tree = random.Random(seed), [json.loads(sound)]
    for _ in range(rng.randint(1, 3)):
        places = list(inside(tree))
        at, key = rng.choice(places)
        if rng.random() < 0.2 and at is not tree:
            del at[key]
        else:
            there = rng.choice([*ODD, *(holder[name] for holder, name in places)])
            at[key] = json.loads(json.dumps(there))
    return json.dumps(tree[0]).encode()


ODD = [None, True, -1, 0, 7, 2**70, 0.5, math.nan, -math.inf, "", "x", "a", [], [1], {}, {"a": 1}]


def inside(node: Any) -> Iterator[tuple[Any, Any]]:
    """Holder and key of everything in a tree."""
    keys = list(node) if isinstance(node, dict) else range(len(node))
    for key in keys:
        yield node, key
        if isinstance(node[key], dict | list):
            yield from inside(node[key])


def refused(
    path: Path,
    sound: bytes,
    read: Callable[[Path], Any],
    error: type[Exception],
    whole: Callable[[bytes], bytes],
) -> int:
    """Number of mutants that are refused by the error; any other error is raised, with its seed."""
    count = 0
    for seed in range(NUMBER):
        path.write_bytes(whole(mutant_of_json(sound, seed)))
        try:
            read(path)
        except error:
            count += 1
        except Exception as escaped:
            escaped.add_note(f"of the mutant {seed}")
            raise
    return count


def checked(body: bytes) -> bytes:
    """The file of a body, with its true checksum."""
    digest = hashlib.blake2b(body, digest_size=32).digest()
    return b"\x89FIDE\r\n\x1a" + struct.pack("<I", checkpoint.VERSION) + digest + body


def parts(path: Path) -> tuple[bytes, Callable[[bytes], bytes]]:
    """JSON of a checkpoint, and what makes a file of such JSON and the same arrays."""
    body = path.read_bytes()[44:]
    (length,) = struct.unpack("<Q", body[:8])
    arrays = body[8 + length :]

    def whole(text: bytes) -> bytes:
        return checked(struct.pack("<Q", len(text)) + text + arrays)

    return body[8 : 8 + length], whole


@pytest.mark.thorough
def test_models(tmp_path: Path) -> None:
    """What is loaded gives hypotheses in the box."""
    untrained().save(tmp_path / "sound")
    text, whole = parts(tmp_path / "sound")

    def read(path: Path) -> None:
        model = Model.load(path)
        with suppress(ImageError):  # it says that it has learned images of another aspect
            X = model.sample(np.zeros((*model.size, 3)), 2)
            assert X.shape == (2, model.dim) and (X >= 0).all() and (X <= 1).all()
        assert repr(model) and str(model.report)

    count = refused(tmp_path / "mutant", text, read, CheckpointError, whole)
    assert NUMBER / 3 < count < NUMBER


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e300])
@pytest.mark.parametrize("part", ["weights", "emulator"])
def test_weights_that_are_not_finite_are_refused_by_name(
    part: str, value: float, tmp_path: Path
) -> None:
    """1e300 is finite in double precision, but not in that of the network."""
    untrained(emulator=True).save(tmp_path / "sound")
    state = checkpoint.read(tmp_path / "sound", "learned model")
    name = [*state[part]][-1]
    weight = np.array(state[part][name], np.float64)
    weight.flat[0] = value
    state[part][name] = weight
    checkpoint.write(tmp_path / "odd", "learned model", state)
    with pytest.raises(CheckpointError, match=re.escape(repr(name))):
        Model.load(tmp_path / "odd")


def untrained(emulator: bool = False) -> Model:
    """A model of two blocks of two parameters, as it is before any training."""
    blocks, periodic = ((0, 1), (2, 3)), (False,) * 4
    report = Report(
        renders=90, failed=0, held_out=10, seconds=1.5, nll=-2.5, within=(0.5, 1.0), coverage=0.9,
        unseen=("b.x",), curve=((90.0, -1.0, -0.5),), augment="none", scale=1.0, fitted=0,
        emulated=0.95,
    )  # fmt: skip
    return Model(
        Network((4, 4), periodic, blocks),
        Space(b=2 * Group(x=Float(0, 1), y=Float(0, 1))),
        (8, 8), "scene.py:render", None,
        Familiarity(np.zeros(256), np.eye(256), 1.0), report,
        emulator=Emulator((4, 4), periodic, blocks) if emulator else None,
    )  # fmt: skip


# -- what is no file -------------------------------------------------------------------------------


def make_pipe(path: Path) -> None:
    os.mkfifo(path)


def make_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(os.fspath(path))


def make_link_to_a_device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def make_too_large(path: Path) -> None:
    path.write_bytes(b"{}")
    os.truncate(path, 2**40)  # it takes no room on the disk


NO_FILES = [make_pipe, make_socket, make_link_to_a_device, make_too_large]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
@pytest.mark.timeout(20)  # a pipe would be waited for
@pytest.mark.parametrize("make", NO_FILES)
def test_only_files_are_read(
    make: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # the name of a socket may not be long
    path = Path("run.json")
    make(path)
    with pytest.raises(RunDirectoryError, match="a pipe, a socket or a device|more than"):
        read_run(Path())
    with pytest.raises(OSError, match="a pipe, a socket or a device|more than"):
        files.read_regular(path)
    if make is not make_too_large:
        with pytest.raises(CheckpointError, match="a pipe, a socket or a device"):
            checkpoint.read(path, "test")
        with pytest.raises(ImageError, match="a pipe, a socket or a device"):
            as_target(path)


@pytest.mark.skipif(not hasattr(os, "O_NOFOLLOW"), reason="no such links here")
def test_a_lock_leads_nowhere_else(tmp_path: Path) -> None:
    """A run directory of somebody else's may hold a link in the place of its lock."""
    (tmp_path / "lock").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError), files.locked(tmp_path / "lock"):
        pass
    assert not (tmp_path / "elsewhere").exists()
