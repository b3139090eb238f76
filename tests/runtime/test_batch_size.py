"""Batch sizes if a device or the CPU has too little memory."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from fide_plugins.runtime.devices import (
    BatchSize,
    is_out_of_gpu_memory,
    is_out_of_memory,
    stack,
)

CPU = RuntimeError(
    "[enforce fail at alloc_cpu.cpp:124] err == 0. DefaultCPUAllocator: can't allocate memory: you "
    "tried to allocate 4000000000000 bytes. Error code 12 (Cannot allocate memory)"
)
DEVICE = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB.")
LIBRARY = RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`")


@pytest.mark.parametrize("error", [CPU, DEVICE, LIBRARY, MemoryError()])
def test_whatever_says_so_makes_pieces_smaller(error: Exception) -> None:
    done: list[int] = []

    def work(piece: slice) -> None:
        if piece.stop - piece.start > 3:
            raise error
        done.extend(range(piece.start, piece.stop))

    assert is_out_of_memory(error)
    with pytest.warns(RuntimeWarning, match="from now on 4") as warned:
        BatchSize(8, "things").each(work, 11)
    assert done == list(range(11)) and len(warned) == 1


def test_torch_reports_the_cpu_s_memory_so() -> None:
    """In words that may change with its version."""
    with pytest.raises(RuntimeError) as caught:
        torch.empty(2**58, dtype=torch.uint8)
    assert is_out_of_memory(caught.value) and not is_out_of_gpu_memory(caught.value)


@pytest.mark.parametrize(
    ("error", "of_gpu"), [(CPU, False), (DEVICE, True), (LIBRARY, True), (MemoryError(), False)]
)
def test_whose_memory_it_is(error: Exception, of_gpu: bool) -> None:
    assert is_out_of_gpu_memory(error) is of_gpu


def test_other_errors_are_none_of_it() -> None:
    def work(piece: slice) -> None:
        raise RuntimeError("mat1 and mat2 shapes cannot be multiplied")

    with pytest.raises(RuntimeError, match="mat1"):
        BatchSize(8, "things").each(work, 8)
    assert not is_out_of_memory(ValueError("out of memory"))


def test_a_stack_that_is_too_large_for_a_device_is_on_the_cpu(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tensors, honest, tried = [torch.full((2,), float(i)) for i in range(3)], torch.stack, []

    def small(tensors: list[Tensor]) -> Tensor:
        tried.append(len(tensors))
        if len(tried) == 1:
            raise DEVICE
        return honest(tensors)

    monkeypatch.setattr(torch, "stack", small)
    assert stack(tensors).tolist() == [[0, 0], [1, 1], [2, 2]] and tried == [3, 3]

    def broken(tensors: list[Tensor]) -> Tensor:
        raise RuntimeError("stack expects each tensor to be equal size")

    monkeypatch.setattr(torch, "stack", broken)
    with pytest.raises(RuntimeError, match="equal size"):
        stack(tensors)
