"""The choice of a variant: what is tried, what is said, what is refused."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from fide_tasks import mitsuba_variant
from fide_tasks.mitsuba_variant import choose, in_variant, problem_with

pytest.importorskip("mitsuba", reason="Mitsuba is not installed: pip install mitsuba")


@pytest.fixture
def forgetful() -> Iterator[None]:
    """A process that has not chosen yet; afterwards the real choices are found again."""
    mitsuba_variant.problem_with.cache_clear()
    mitsuba_variant._best.cache_clear()
    yield
    mitsuba_variant.problem_with.cache_clear()
    mitsuba_variant._best.cache_clear()


def test_names_of_variants() -> None:
    assert choose("scalar") == choose("scalar_rgb") == "scalar_rgb"
    assert choose("auto") in mitsuba_variant.VARIANTS.values()
    with pytest.raises(ValueError, match="variant must be one of 'auto', 'cuda', 'llvm'.*'gpu'"):
        choose("gpu")


@pytest.mark.usefixtures("forgetful")
def test_without_a_gpu_or_llvm_it_is_scalar_and_says_so_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(mitsuba_variant, "_check_variant", lambda variant, library: "it does not")
    with caplog.at_level(logging.INFO):
        assert [choose("auto"), choose("auto")] == ["scalar_rgb"] * 2
    assert len(caplog.messages) == 1
    assert "slower than it could" in caplog.text
    assert "apt-get install libllvm19" in caplog.text
    for variant in ("llvm", "cuda_ad_rgb"):
        with pytest.raises(ValueError, match=f"variant {variant[:4]}.* does not run here"):
            choose(variant)
    with pytest.raises(ValueError, match="apt-get install libllvm19.*DRJIT_LIBLLVM_PATH"):
        choose("llvm")
    with pytest.raises(ValueError, match="needs an NVIDIA GPU"):
        choose("cuda")


@pytest.mark.usefixtures("forgetful")
def test_libraries_are_tried_newest_first_until_one_works(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in ("libLLVM-9.so.1", "libLLVM-15.so.1", "libLLVM.so.20.1", "libLLVM.so.19.1"):
        (tmp_path / name).touch()
    (tmp_path / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    tried = []

    def check(variant: str, library: str | None) -> str | None:
        tried.append(library and Path(library).name)
        return None if library and library.endswith("libLLVM-15.so.1") else "it aborts the process"

    monkeypatch.setattr(mitsuba_variant, "_LIBRARY_PLACES", (f"{tmp_path}/libLLVM*.so*",))
    monkeypatch.setattr(mitsuba_variant, "_check_variant", check)
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    assert problem_with("llvm") is None
    assert tried == ["libLLVM.so.20.1", "libLLVM.so.19.1", "libLLVM-15.so.1"]
    assert os.environ["DRJIT_LIBLLVM_PATH"] == str(tmp_path / "libLLVM-15.so.1")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/a/library.so")
    tried.clear()
    mitsuba_variant.problem_with.cache_clear()
    assert problem_with("llvm") == "/a/library.so: it aborts the process"
    assert tried == ["library.so"], "a library that the user names is the only one"


def test_a_variant_that_aborts_does_so_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mitsuba_variant, "_CHECK", "import os; os.abort()")
    assert mitsuba_variant._check_variant("llvm_ad_rgb", None) == "it aborts the process (signal 6)"
    monkeypatch.setattr(mitsuba_variant, "_CHECK", "raise SystemExit('no such thing')")
    assert mitsuba_variant._check_variant("llvm_ad_rgb", None) == "no such thing"
    monkeypatch.setattr(mitsuba_variant, "_CHECK", "import time; time.sleep(60)")
    monkeypatch.setattr(mitsuba_variant, "_CHECK_SECONDS", 0.5)
    assert "rendered nothing within" in str(mitsuba_variant._check_variant("llvm_ad_rgb", None))


def test_without_mitsuba_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib.util

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"pip install mitsuba .*extra mitsuba"):
        choose("auto")


def test_the_variant_and_the_threads_of_others_are_put_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import drjit as dr
    import mitsuba as mi

    monkeypatch.setattr(mitsuba_variant, "_left", None)  # other tests may have left any
    other = "scalar_rgb" if choose("auto") != "scalar_rgb" else "scalar_spectral"
    mi.set_variant(other)
    threads = dr.thread_count()
    with in_variant(choose("auto"), threads=1) as inside:
        assert inside.variant() == choose("auto")
        assert dr.thread_count() == 1
    assert mi.variant() == other
    assert dr.thread_count() == threads
