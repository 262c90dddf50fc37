"""Several processes that train one network: each takes a share of the batch, gradients are averaged.

On a shared CPU two processes of one thread beat one process of two: they meet once a step, not at every
operation.
"""

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
import torch.distributed as dist
from torch import Tensor, nn

from bathyscope import errors
from bathyscope.errors import BathyscopeError, SettingsError

_TOLD = "error-{rank}.json"


def launch(work: Callable[[int], None], workers: int) -> None:
    """Run ``work(rank)`` in ``workers`` processes that can talk to each other.

    One worker runs in this process. Under ``torchrun``, which starts the processes itself, this one is the worker
    that the environment says it is.

    Raises:
        SettingsError: If ``torchrun`` started another number of processes.
        BathyscopeError: What a worker raised.
    """
    if "RANK" in os.environ:
        started = int(os.environ["WORLD_SIZE"])
        if started != workers:
            raise SettingsError(f"settings ask for {workers} workers, but {started} processes were started")
        _work("env://", int(os.environ["RANK"]), workers, work)
    elif workers == 1:
        work(0)
    else:
        from torch.multiprocessing.spawn import ProcessExitedException, spawn

        with TemporaryDirectory(prefix="bathyscope-train-") as made:
            folder = Path(made)
            try:
                spawn(_join, args=(folder, workers, work), nprocs=workers)
            except ProcessExitedException:
                for file in folder.glob(_TOLD.format(rank="*")):
                    kind, message = json.loads(file.read_text(encoding="utf-8"))
                    raise getattr(errors, kind)(message) from None
                raise


def share_gradients(parameters: Sequence[nn.Parameter], progress: float) -> float:
    """Average the gradients over all workers, in place; returns the progress of worker 0, for all to follow.

    A parameter without a gradient counts as zero, so that all workers hold the same shapes.
    """
    if not dist.is_initialized():
        return progress
    count = dist.get_world_size()
    flat = [p.grad.flatten() if p.grad is not None else torch.zeros_like(p).flatten() for p in parameters]
    own = torch.tensor([progress if dist.get_rank() == 0 else 0.0])
    joined = torch.cat([*flat, own])
    dist.all_reduce(joined)
    start = 0
    for parameter in parameters:
        part = joined[start : start + parameter.numel()] / count
        parameter.grad = part.reshape(parameter.shape)
        start += parameter.numel()
    return float(joined[-1])


def average(values: Tensor) -> Tensor:
    """Mean over all workers."""
    if dist.is_initialized():
        values = values.clone()
        dist.all_reduce(values)
        values /= dist.get_world_size()
    return values


def _join(rank: int, folder: Path, workers: int, work: Callable[[int], None]) -> None:
    """A spawned worker; an error of ours is left in the folder, for the parent to raise it as it was."""
    try:
        _work((folder / "meeting").as_uri(), rank, workers, work)
    except BathyscopeError as error:
        told = folder / _TOLD.format(rank=rank)
        told.write_text(json.dumps([type(error).__name__, str(error)]), encoding="utf-8")
        raise SystemExit(1) from error


def _work(meeting: str, rank: int, workers: int, work: Callable[[int], None]) -> None:
    dist.init_process_group("gloo", init_method=meeting, rank=rank, world_size=workers)
    try:
        work(rank)
    finally:
        dist.destroy_process_group()
