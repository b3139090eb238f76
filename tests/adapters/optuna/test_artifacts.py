"""Images in artifact stores (acceptance point 16)."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path
from typing import Any, BinaryIO
from zlib import compress, crc32

import numpy as np
import optuna
import pytest
from optuna.artifacts import FileSystemArtifactStore, get_all_artifact_meta, upload_artifact
from optuna.samplers import RandomSampler
from optuna.trial import Trial
from PIL import Image

from .conftest import Bench, counts_of, with_attributes


def test_point_16_pictures_are_kept_and_shown(bench: Bench, tmp_path: Path) -> None:
    store = FileSystemArtifactStore(str(tmp_path))
    study = optuna.create_study(sampler=bench.sampler(artifact_store=store))
    bench.run(study, 5)
    for trial in study.trials:
        (meta,) = get_all_artifact_meta(trial, storage=study._storage)
        assert (meta.mimetype, meta.filename) == ("image/png", "image.png")
        with store.open_reader(meta.artifact_id) as reader:
            pixels = np.asarray(Image.open(reader))
        image = bench.render([trial.params[name] for name in bench.names])
        np.testing.assert_array_equal(pixels, np.round(image * 255))


def upload(trial: Any, study: optuna.Study, store: Any, image: Any, folder: Path) -> None:
    path = folder / f"{trial.number}.png"
    Image.fromarray(np.round(image * 255).astype(np.uint8)).save(path)
    upload_artifact(
        artifact_store=store, file_path=str(path), study_or_trial=trial, storage=study._storage
    )


def test_point_16_an_artifact_of_the_objective_is_seen(bench: Bench, tmp_path: Path) -> None:
    store = FileSystemArtifactStore(str(tmp_path))
    study = optuna.create_study(sampler=bench.sampler(artifact_store=store))

    def objective(trial: Trial) -> float:
        image = bench.render(bench.suggest(trial))
        upload(trial, study, store, image, tmp_path)
        return float(np.square(image - bench.target).mean())

    study.optimize(objective, n_trials=10)
    assert bench.sampler_of(study).counts(study)["image"] == 10
    study.sampler = bench.sampler()  # who has no store learns from what was recorded
    assert "fide:image" in study.trials[3].system_attrs
    bench.run(study, 1)
    assert bench.sampler_of(study).counts(study)["image"] == 11


def test_point_16_artifacts_of_another_sampler_s_trials(bench: Bench, tmp_path: Path) -> None:
    """Of three, one picture was lost and one is no picture: one warning, all three count."""
    store = FileSystemArtifactStore(str(tmp_path / "store"))
    (tmp_path / "store").mkdir()
    study = optuna.create_study(sampler=RandomSampler(seed=0))

    def objective(trial: Trial) -> float:
        image = bench.render(bench.suggest(trial))
        upload(trial, study, store, image, tmp_path)
        return float(np.square(image - bench.target).mean())

    study.optimize(objective, n_trials=4)
    ids = [
        get_all_artifact_meta(trial, storage=study._storage)[0].artifact_id
        for trial in study.trials
    ]
    store.remove(ids[1])
    (tmp_path / "store" / ids[2]).write_bytes(b"\x89PNG no longer")
    study.sampler = bench.sampler(artifact_store=store)
    with pytest.warns(RuntimeWarning, match="counts without it") as caught:
        bench.run(study, 3)
    assert len(caught) == 1
    counts = bench.sampler_of(study).counts(study)
    assert counts == {"injected": 4, "member": 3, "image": 5}


class ClientError(Exception):
    """Of a store's client: a direct subclass of Exception, as that of S3."""


class Closed(FileSystemArtifactStore):
    def open_reader(self, artifact_id: str) -> BinaryIO:
        raise ClientError("access denied")


def bomb() -> bytes:
    """PNG of a few bytes whose header says 20,000 x 20,000 pixels, which PIL refuses."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", crc32(kind + data))

    size = struct.pack(">IIBBBBB", 20_000, 20_000, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", size) + chunk(b"IDAT", compress(b""))


@pytest.mark.parametrize(
    ("kind", "message"),
    [(FileSystemArtifactStore, "decompression bomb"), (Closed, "access denied")],
)
def test_an_image_that_cannot_be_read_for_any_reason_costs_only_itself(
    bench: Bench, tmp_path: Path, kind: type[FileSystemArtifactStore], message: str
) -> None:
    (tmp_path / "store").mkdir()
    study = optuna.create_study(sampler=RandomSampler(seed=0))

    def objective(trial: Trial) -> float:
        upload(trial, study, FileSystemArtifactStore(tmp_path / "store"), bench.target, tmp_path)
        return sum(bench.suggest(trial))

    study.optimize(objective, n_trials=1)
    for path in (tmp_path / "store").iterdir():
        path.write_bytes(bomb())
    study.sampler = bench.sampler(artifact_store=kind(tmp_path / "store"))
    with pytest.warns(RuntimeWarning, match=f"counts without it: .*{message}"):
        study.optimize(lambda trial: sum(bench.suggest(trial)), n_trials=2)
    assert counts_of(study) == {"injected": 1, "member": 2, "image": 0}


@pytest.mark.parametrize(
    "stored",
    [
        "no json",
        None,
        '{"artifact_id": "a"}',
        '{"artifact_id": "a", "filename": "a", "mimetype": null, "encoding": null}',
        '{"artifact_id": 3, "filename": "a", "mimetype": "image/png", "encoding": null}',
        '{"artifact_id": "../a", "filename": "a", "mimetype": "image/png", "encoding": null}',
    ],
)
def test_a_note_of_an_artifact_that_is_none_is_ignored(
    bench: Bench, stored: Any, tmp_path: Path
) -> None:
    """Nor is a picture read that is outside of the store."""
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "a", "PNG")
    (tmp_path / "store").mkdir()
    store = FileSystemArtifactStore(tmp_path / "store")
    study = optuna.create_study(sampler=bench.sampler(artifact_store=store))
    study.add_trial(with_attributes(bench, {"artifacts:a": stored}))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        bench.run(study, 5)
    is_no_image = isinstance(stored, str) and 'null, "enc' in stored
    assert [str(w.message)[:21] for w in caught] == ["the image of trial 0 "] * (not is_no_image)
    assert counts_of(study) == {"injected": 1, "member": 5, "image": 5}
