"""Several processes that train one network, as ``torchrun`` starts them; without it, this one alone.

    torchrun --no-python --nproc-per-node 2 bathyscope train configs/consistency.yaml data=FOLDER init=FILE batch=2

Every process works through its share of each batch; gradients are averaged by ``DistributedDataParallel``.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist
from jaxtyping import Float
from torch import Tensor

from bathyscope_train.devices import choose_device

_PATIENCE = timedelta(hours=2)
"""How long the others wait while the first looks through all videos, or validates."""


@dataclass(frozen=True, slots=True)
class Processes:
    """Which of several processes this is, and the device it works on."""

    rank: int
    world_size: int
    device: torch.device

    @property
    def first(self) -> bool:
        """Whether this process writes the files."""
        return self.rank == 0

    def mean(self, values: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Mean over all processes; all have to ask."""
        if self.world_size > 1:
            values = values.clone()
            dist.all_reduce(values)
            values /= self.world_size
        return values

    def wait(self) -> None:
        """Until all processes are here."""
        if self.world_size > 1:
            dist.barrier()


@contextmanager
def joined(device: str) -> Iterator[Processes]:
    """This process among those of ``torchrun``, which says so in the environment; leaves them at the end.

    Args:
        device: ``auto``, ``cpu`` or ``cuda``; each process of a machine takes a GPU of its own.

    Raises:
        SettingsError: If cuda is asked for where there is none.
    """
    chosen = choose_device(device)
    world_size = int(os.environ.get("WORLD_SIZE", "1"))
    if world_size == 1:
        yield Processes(0, 1, chosen)
        return
    if chosen.type == "cuda":
        chosen = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
        torch.cuda.set_device(chosen)
    dist.init_process_group("nccl" if chosen.type == "cuda" else "gloo", timeout=_PATIENCE)
    try:
        yield Processes(dist.get_rank(), dist.get_world_size(), chosen)
    finally:
        dist.destroy_process_group()
