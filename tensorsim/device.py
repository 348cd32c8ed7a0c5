"""Which device to run on, and how many threads."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from tensorsim.errors import TensorsimError, first_line


def usable_device(name: str) -> torch.device:
    """The torch device of this name; ``"auto"`` is a GPU if there is one, otherwise the CPU.

    Raises:
        TensorsimError: the device cannot be used on this machine.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        # Some devices have tensors but no values (meta), or a name but no library.
        usable = float(torch.ones(2, device=device).sum()) == 2.0
    except Exception as error:  # each backend raises its own errors
        raise TensorsimError(f"--device: {name!r} is not usable here: {first_line(error)}") from None
    if not usable:
        raise TensorsimError(f"--device: {name!r} is not usable here: it gets a simple sum wrong")
    return device


def multiplies_bfloat16(device: torch.device) -> bool:
    """Whether the device has native bfloat16 multiplication; without it, bfloat16 is slower than float32.

    GPUs have it; processors have it with AMX or AVX-512 (x86) or the bfloat16 extension (ARM).
    """
    if device.type != "cpu":
        return True
    found = torch.cpu.get_capabilities()
    return any(bool(found.get(name)) for name in ("amx_bf16", "avx512_bf16", "bf16"))


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread inside the block.

    Sums over several threads can differ in the last bits, and many small operations are slower on several threads.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def rank_and_processes() -> tuple[int, int]:
    """Rank of this process and number of processes started by ``torchrun``; 0 and 1 for a single process."""
    return int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
