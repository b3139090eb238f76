"""Workers in processes of their own, one of which is killed (acceptance point 8)."""

from __future__ import annotations

import json
import os
import pwd
import shutil
import subprocess
import sys
from collections.abc import Iterator
from math import inf
from pathlib import Path

import optuna
import pytest
from optuna.storages import JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState

from fide_adapters.optuna.storage import read_ask

CROWD = Path(__file__).with_name("crowd.py")
WORKERS, TRIALS, DIES = 4, 6, 3


def postgresql() -> Path | None:
    """Folder of the server's programs, where Debian's package puts them, or on the path."""
    found = shutil.which("initdb")
    folders = [Path(found).parent] if found else []
    folders += sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    return next((folder for folder in folders if (folder / "initdb").exists()), None)


@pytest.fixture(scope="module")
def database() -> Iterator[str | None]:
    """URL of a new PostgreSQL server that listens to a socket in a folder; None: there is none."""
    programs = postgresql()
    if programs is None:
        yield None
        return
    folder = Path("/tmp") / f"fide-postgresql-{os.getpid()}"  # short, as sockets must be
    folder.mkdir(mode=0o700)
    as_user: list[str] = []
    if os.getuid() == 0:  # the server refuses to be root
        user = pwd.getpwnam("postgres")
        os.chown(folder, user.pw_uid, user.pw_gid)
        as_user = ["setpriv", f"--reuid={user.pw_uid}", f"--regid={user.pw_gid}", "--clear-groups"]
    quick = "-c fsync=off -c synchronous_commit=off -c shared_buffers=16MB"
    options = f"{quick} -c listen_addresses='' -k {folder}"

    def call(program: str, *arguments: str) -> None:
        command = [*as_user, str(programs / program), "-D", str(folder / "data"), *arguments]
        subprocess.run(command, check=True, capture_output=True, cwd=folder)

    try:
        call("initdb", "-U", "postgres", "--auth=trust", "--no-sync", "-E", "UTF8")
        call("pg_ctl", "-w", "-l", str(folder / "log"), "-o", options, "start")
        try:
            yield f"postgresql+psycopg://postgres@/postgres?host={folder}"
        finally:
            call("pg_ctl", "-w", "-m", "immediate", "stop")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module")
def folders(
    database: str | None, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, tuple[Path, str]]:
    """Where a crowd has worked on each kind of storage, and the storage."""
    journal = tmp_path_factory.mktemp("journal")
    places = {"journal": (journal, str(journal / "study.log"))}
    if database is not None:
        places["postgresql"] = (tmp_path_factory.mktemp("postgresql"), database)
    settings = map(str, (WORKERS, TRIALS, DIES))
    arguments = [str(part) for place in places.values() for part in place]
    done = subprocess.run(
        [sys.executable, str(CROWD), *settings, *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return places


def places(trials: list[FrozenTrial], complete: list[FrozenTrial]) -> list[float]:
    """Where each of the trials `complete` counts, see `fide_adapters.optuna.trials`.

    On a busy machine some are skipped; each counts at the first trial whose record says so, if any
    does: two workers that ask at the same moment may both say it.  A trial that is skipped itself
    is no place.
    """
    asks = {t.number: ask for t in trials if (ask := read_ask(t)) is not None}
    skipped = {number for ask in asks.values() for number in ask.skipped}
    late: dict[int, int] = {}
    for at in sorted(asks.keys() - skipped):
        late |= {number: at for number in asks[at].late if number not in late}
    return [late.get(t.number, inf if t.number in skipped else t.number) for t in complete]


def check(study: optuna.Study, folder: Path) -> None:
    trials = study.get_trials(deepcopy=False)
    complete = [t for t in trials if t.state is TrialState.COMPLETE]
    running = [t for t in trials if t.state is TrialState.RUNNING]
    assert len(running) == 1  # what the killed worker was at
    assert len(complete) == TRIALS * (WORKERS - 1) + DIES
    assert all("fide:image" in t.system_attrs for t in complete)
    assert len({tuple(t.params.values()) for t in trials}) == len(trials)  # nothing asked twice
    beliefs = [json.loads(path.read_text()) for path in folder.glob("belief-*.json")]
    assert len(beliefs) == len({b["pid"] for b in beliefs}) == WORKERS - 1
    for belief in beliefs:
        assert {**belief, "pid": 0} == {**beliefs[0], "pid": 0}
    counts, at = beliefs[0]["counts"], beliefs[0]["at"]
    told = sum(counts.get(role, 0) for role in ("member", "late", "injected", "altered"))
    counted = sum(place < at for place in places(trials, complete))
    assert told == counts["image"] == counted  # each exactly once
    assert told + counts.get("waiting", 0) == len(complete)  # and none is lost
    assert at >= running[0].number


@pytest.mark.thorough
def test_point_8_four_processes_on_a_journal(folders: dict[str, tuple[Path, str]]) -> None:
    folder, path = folders["journal"]
    storage = JournalStorage(JournalFileBackend(path))
    check(optuna.load_study(study_name="crowd", storage=storage), folder)


def test_point_8_four_processes_on_postgresql(folders: dict[str, tuple[Path, str]]) -> None:
    if "postgresql" not in folders:
        pytest.skip("PostgreSQL is not installed (apt-get install postgresql)")
    folder, url = folders["postgresql"]
    storage = RDBStorage(url)
    check(optuna.load_study(study_name="crowd", storage=storage), folder)
    storage.remove_session()
    storage.engine.dispose()
