"""Speed of training: precision, memory, processes. The learned weights are the same up to rounding.

Tensors stay contiguous (NCHW) on every device. In `channels_last` oneDNN writes past a buffer in
the backward pass of strided 1 x 1 convolutions with fewer channels than its block: the shortcuts
of a narrow ResNet. On processors with AVX2 only, the gradients are then wrong, or the process
crashes or hangs (oneDNN issue 6035, present in PyTorch 2.13.0). The gain was small:
docs/benchmarks.md. `torch.compile` is not used, because on a CPU it chooses `channels_last` itself.
"""

import contextlib
import ctypes
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel

from orthonav.core.cores import usable_cores

GPU_WORKERS = 16
"""Threads that make batches for a GPU: more tiles than one thread cuts, and positives take far
longer than tiles."""


@dataclass(frozen=True)
class Means:
    """Options for the speed of training; the learned weights are the same up to rounding.

    - `bf16`: mixed precision with bfloat16; None: if the processor has its instructions, else with
      float16 on a GPU.
    - `fused`: run the optimizer's step in one pass over memory.
    - `keep_memory`: let the process keep freed memory (Linux, CPU).
    - `chunk`: tiles of a triplet batch held for gradients at once; batch norms use each chunk.
    - `workers`: threads that make batches; None: 2 for a CPU, one per core up to 16 for a GPU.
    - `save_every_s`: shortest time between checkpoints, s.
    - `device`: name for PyTorch; None: a GPU if there is one.
    """

    bf16: bool | None = None
    fused: bool = True
    keep_memory: bool = True
    chunk: int = 128
    workers: int | None = None
    save_every_s: float = 300.0
    device: str | None = None


@dataclass(frozen=True)
class World:
    """Rank of this process, number of processes, rank on this machine (from torchrun)."""

    rank: int = 0
    size: int = 1
    local_rank: int = 0


def device_of(means: Means, world: World) -> torch.device:
    """Device on which this process trains."""
    name = means.device or ("cuda" if torch.cuda.is_available() else "cpu")
    return torch.device("cuda", world.local_rank) if name == "cuda" else torch.device(name)


def mixed_precision(means: Means, device: torch.device) -> torch.dtype | None:
    """Type for mixed precision: as `means.bf16` says, else bfloat16 if the device supports it.

    A GPU without it, before NVIDIA's Ampere, gets float16; on other processors float32 is faster.
    """
    if means.bf16 is not None:
        return torch.bfloat16 if means.bf16 else None
    if device.type == "cuda":
        able = torch.cuda.is_bf16_supported(including_emulation=False)
        return torch.bfloat16 if able else torch.float16
    # Older releases of PyTorch lack this function.
    found: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    able = any(bool(found.get(name)) for name in ("avx512_bf16", "amx_bf16", "bf16"))
    return torch.bfloat16 if able else None


def workers_of(means: Means, device: torch.device) -> int:
    """Threads that make batches."""
    if means.workers is not None:
        return means.workers
    return min(GPU_WORKERS, usable_cores()) if device.type == "cuda" else 2


def wrapped(model: nn.Module, device: torch.device, world: World) -> nn.Module:
    """The model; with several processes, wrapped so that gradients are averaged over them."""
    if world.size == 1:
        return model
    ids = [world.local_rank] if device.type == "cuda" else None
    return DistributedDataParallel(model, device_ids=ids)


@contextlib.contextmanager
def processes(means: Means) -> Iterator[World]:
    """Process group set up by torchrun for as long as this lasts; one process without torchrun."""
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        yield World()
        return
    local = int(os.environ.get("LOCAL_RANK", "0"))
    device = device_of(means, World(local_rank=local))
    if device.type == "cuda":
        torch.cuda.set_device(device)
    ours = not distributed.is_initialized()
    if ours:
        distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    try:
        yield World(distributed.get_rank(), distributed.get_world_size(), local)
    finally:
        if ours:
            distributed.destroy_process_group()


def mean_over_processes(value: Tensor, world: World, device: torch.device) -> float:
    """Mean of a number over all processes."""
    if world.size > 1:
        value = value.to(device)
        distributed.all_reduce(value)
        value = value / world.size
    return float(value)


@contextlib.contextmanager
def kept_memory(wanted: bool) -> Iterator[None]:
    """Let glibc keep freed memory while this lasts, instead of returning it to the system.

    Every step allocates and frees hundreds of MB of activations and gradients. Zero-filled pages
    from the system cost as much as the arithmetic (mallopt(3)).
    """
    try:
        library = ctypes.CDLL(None) if wanted and sys.platform == "linux" else None
        mallopt, trim = library and library.mallopt, library and library.malloc_trim
    except (OSError, AttributeError):
        mallopt = trim = None
    if not mallopt or not trim:
        yield
        return
    trim_threshold, mmap_max = -1, -4
    mallopt(mmap_max, 0)
    mallopt(trim_threshold, -1)
    try:
        yield
    finally:
        mallopt(mmap_max, 65_536)
        mallopt(trim_threshold, 128 * 1024)
        trim(0)
