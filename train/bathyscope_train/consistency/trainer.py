"""The consistency optimisation: steps on windows of videos, checkpoints, validation, and a way back."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from bathyscope.errors import GeometryError, SettingsError
from bathyscope_train.consistency.batches import balanced_weights, mean_over, parts_of
from bathyscope_train.consistency.checkpoint_folder import Kept, read_last_checkpoint, write_checkpoint, write_weights
from bathyscope_train.consistency.clip_step import TOTAL, ClipStep
from bathyscope_train.consistency.optimizer_state import optimizer_tensors, restore_optimizer
from bathyscope_train.consistency.parts import learning_rate, optimizer_groups, set_trainable, trained_groups
from bathyscope_train.consistency.pictures import picture_grid
from bathyscope_train.consistency.processes import Processes, joined
from bathyscope_train.consistency.records import check_same_run, training_record, write_settings
from bathyscope_train.consistency.reports import Reports, mean_numbers
from bathyscope_train.consistency.settings import ConsistencySettings
from bathyscope_train.consistency.start import load_initial, open_training_windows, video_kind
from bathyscope_train.consistency.video_step import VideoStep
from bathyscope_train.consistency.watch import Watch
from bathyscope_train.data.clip_loader import FrameBatch, WindowLoader
from bathyscope_train.data.clip_sources import sources_hash
from bathyscope_train.data.clip_windows import ClipWindows
from bathyscope_train.devices import use_bfloat16
from bathyscope_train.losses.supervised import splatting
from bathyscope_train.model.network import Network
from bathyscope_train.schedule import ema_decay

WEIGHTS_FILE = "model.safetensors"

_log = logging.getLogger(__name__)


def optimise(settings: ConsistencySettings) -> Path:
    """Train, or go on with the run in ``settings.out``; returns the path of the weights.

    The folder gets ``model.safetensors`` at the end, and on the way ``checkpoints/``, ``metrics.jsonl``,
    ``settings.json``, ``pictures/`` and ``tensorboard/``. Under ``torchrun`` all processes call this.

    Raises:
        SettingsError: If the network cannot be trained this way.
        CheckpointError: If the initial checkpoint or the last one of the run cannot be used, or none can be written.
        DatasetError: If no video holds a window.
        TrainingError: If the run has gone wrong; the last good checkpoint stays.
    """
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    with joined(settings.device) as processes:
        if not processes.first:
            logging.getLogger().setLevel(logging.WARNING)
        run = run_of(settings)(settings, processes)
        try:
            return run.train()
        finally:
            run.close()


def run_of(settings: ConsistencySettings) -> type[ConsistencyRun]:
    """How the network that ``settings.init`` holds is trained."""
    if video_kind(settings.init, settings.preset) is None:
        return ConsistencyRun
    from bathyscope_train.consistency.video_run import VideoRun

    return VideoRun


class ConsistencyRun:
    """One process's side of a run."""

    def __init__(self, settings: ConsistencySettings, processes: Processes) -> None:
        self.settings, self.processes = settings, processes
        _check_shares(settings, processes.world_size)
        torch.manual_seed(settings.seed)
        self.network = self._initial().to(processes.device)
        check_same_run(settings)
        self.autocast = use_bfloat16(settings.precision, processes.device)
        self.step_module = self._objective()
        self.groups = trained_groups(self.network, settings.parts)
        self.optimizer = torch.optim.AdamW(
            optimizer_groups(self.network, self.groups, settings), betas=settings.betas, lr=settings.peak_lr
        )
        self.average = _copy_of(self.network) if settings.ema_decay > 0 else None
        self.watch, self.step = Watch(settings.safety), 0
        self.balance: dict[str, float] = {}
        kept = read_last_checkpoint(settings.out)
        if kept is not None:
            self._restore(kept)
        self.windows = self._open_windows(kept)
        if processes.first:
            write_settings(settings)
        self.loader = self._loader(self.step)
        told = kept.memory.get("recent") if kept is not None else None
        self.reports = Reports(settings, start=self.step, recent=told) if processes.first else None
        self.active: frozenset[str] = frozenset()
        self.shared: nn.Module = self.step_module

    def _initial(self) -> nn.Module:
        """The network that training starts from."""
        return load_initial(self.settings.init, self.settings.preset)

    def _objective(self) -> ClipStep | VideoStep:
        """What is called in every step."""
        renderer = splatting(self.processes.device)
        return ClipStep(cast(Network, self.network), self.settings, renderer, autocast=self.autocast)

    def _parts(self, batch: FrameBatch) -> Sequence[tuple[Any, ...]]:
        """What it is called with: the batch on the device, in parts."""
        return parts_of(batch, self.settings, self.processes.device)

    def train(self) -> Path:
        """Take the steps that are left; returns the path of the weights."""
        settings = self.settings
        if self.step == 0:
            self._weigh()
            self._save()
            self._validate()
        while self.step < settings.steps:
            values, batch = self.take_step()
            self._report(values, batch)
            if self.step % settings.checkpoint_every == 0 or self.step == settings.steps:
                self._save()
            if settings.validate_every and (self.step % settings.validate_every == 0 or self.step == settings.steps):
                self._validate()
        path = settings.out / WEIGHTS_FILE
        if self.processes.first:
            write_weights(path, self._result(), training=training_record(settings, self.step))
        self.processes.wait()
        return path

    def close(self) -> None:
        """Stop what runs beside."""
        self.loader.close()
        if self.reports is not None:
            self.reports.close()

    def take_step(self) -> tuple[dict[str, float], FrameBatch]:
        """One update on one batch; returns the numbers of all processes together, and this process's batch."""
        settings = self.settings
        self._share()
        batch = next(self.loader)
        self.optimizer.zero_grad(set_to_none=True)
        parts = self._parts(batch)
        found = [self._forward_backward(part, batch.names, last=part is parts[-1]) for part in parts]
        numbers = mean_numbers(found)
        self.watch.see(self.step, numbers)
        norm = nn.utils.clip_grad_norm_(self._trained(), settings.clip_norm)
        rate = learning_rate(self.step, settings)
        for group, made in zip(self.groups, self.optimizer.param_groups, strict=True):
            made["lr"] = rate * group.settings.rate
        if bool(norm.isfinite()):
            self.optimizer.step()
            self.watch.took_step()
            self._move_average()
        else:
            _log.warning("step %d: gradient is not finite on %s; update left out", self.step, ", ".join(batch.names))
            self.watch.skip(self.step)
        self.step += 1
        return {**numbers, "gradient_norm": float(norm), "rate": rate}, batch

    def _forward_backward(self, part: tuple[Any, ...], clips: tuple[str, ...], *, last: bool) -> dict[str, float]:
        """One part of a batch forward and back; gradients are exchanged with the last. Returns all processes' numbers.

        Raises:
            TrainingError: If a number is not finite; nothing has been updated then.
        """
        shared = self.shared
        waits = isinstance(shared, DistributedDataParallel) and not last
        exchange = cast(DistributedDataParallel, shared).no_sync() if waits else nullcontext()
        try:
            with exchange:
                found: dict[str, Tensor] = shared(*part, self.progress)
                numbers = mean_over(found, self.processes)
                self.watch.check_finite(self.step, numbers, clips)
                (found[TOTAL] / self.settings.accumulate).backward()
        except GeometryError as error:
            raise self.watch.broken(self.step, str(error), clips) from error
        return numbers

    @property
    def progress(self) -> float:
        """Share of the run that is over."""
        return self.step / self.settings.steps

    def _share(self) -> None:
        """Freeze what is not trained at this step; when that changes, tell the other processes."""
        active = set_trainable(self.network, self.groups, self.step, self.settings)
        if active == self.active:
            return
        self.active = active
        _log.info("step %d: trains %s", self.step, ", ".join(sorted(active)))
        self.network.train()
        if self.processes.world_size > 1:
            self.shared = DistributedDataParallel(self.step_module, find_unused_parameters=True)

    def _trained(self) -> list[nn.Parameter]:
        return [value for value in self.network.parameters() if value.requires_grad]

    def _move_average(self) -> None:
        if self.average is None:
            return
        decay = ema_decay(self.step, self.settings.ema_decay)
        for name, value in self.network.state_dict().items():
            self.average[name].lerp_(value, 1 - decay)

    def _weigh(self) -> None:
        """Measure the terms, if the weights are shares, on windows that no step trains on."""
        if self.settings.balance_steps == 0:
            return
        with self._loader(self.settings.steps) as loader:
            self.balance = balanced_weights(self.step_module, loader, self.settings, self.processes)
        self.step_module.weigh(self.balance)

    def _open_windows(self, kept: Kept | None) -> ClipWindows:
        """The first process looks through the videos; the others read what it found."""
        if not self.processes.first:
            self.processes.wait()
        windows = open_training_windows(self.settings)
        if self.processes.first:
            self.processes.wait()
            for note in windows.notes:
                _log.warning("data: %s", note)
            _log.info("data: %d videos", len(windows.clips))
        self.data_hash = sources_hash(windows)
        if kept is not None and kept.memory.get("data") != self.data_hash:
            _log.warning("the videos, or what is used of them, are not those that this run began with")
        return windows

    def _loader(self, start: int) -> WindowLoader:
        return WindowLoader(
            self.windows,
            batch=self.settings.batch // self.processes.world_size,
            start=start,
            workers=self.settings.loaders,
            rank=self.processes.rank,
            world_size=self.processes.world_size,
        )

    def _restore(self, kept: Kept) -> None:
        self.network.load_state_dict(kept.model)
        if self.average is not None and kept.average is not None:
            self.average = {name: value.to(self.processes.device) for name, value in kept.average.items()}
        restore_optimizer(self.network, self.optimizer, kept.optimizer)
        self.step = kept.step
        self.watch.recent.extend(kept.memory.get("variation", []))
        self.balance = kept.memory.get("balance", {})
        if self.balance:
            self.step_module.weigh(self.balance)
        _log.info("goes on at step %d with %s", self.step, kept.path)

    def _save(self) -> None:
        if not self.processes.first:
            return
        write_checkpoint(
            self.settings.out,
            self.step,
            self.network,
            optimizer_tensors(self.network, self.optimizer),
            average=self.average,
            memory={
                "variation": list(self.watch.recent),
                "balance": self.balance,
                "data": self.data_hash,
                "recent": self.reports.recent if self.reports is not None else [],
            },
            training=training_record(self.settings, self.step),
            keep=self.settings.keep_checkpoints,
        )

    def _report(self, values: dict[str, float], batch: FrameBatch) -> None:
        if self.reports is None:
            return
        self.reports.tell(self.step, values)
        if self.step % self.settings.pictures_every == 0 or self.step == 1:
            part = self._parts(batch)[0]
            self.reports.picture(self.step, picture_grid(part[0][0], self.step_module.look(*part)))

    def _validate(self) -> None:
        if self.reports is not None and self.settings.validate_every:
            self.reports.validate(self.step, cast(Network, self._result()))

    def _result(self) -> nn.Module:
        """A copy of the network on the CPU, with the running average of the weights where there is one."""
        network = Network(cast(Network, self.network).preset)
        network.load_state_dict(self.average or self.network.state_dict())
        return network.eval()


def _copy_of(network: nn.Module) -> dict[str, Tensor]:
    return {name: value.detach().clone() for name, value in network.state_dict().items()}


def _check_shares(settings: ConsistencySettings, world_size: int) -> None:
    shares = world_size * settings.accumulate
    if settings.batch % shares:
        raise SettingsError(
            f"a batch of {settings.batch} cannot be shared evenly by {world_size} processes in {settings.accumulate} "
            f"parts; set batch to a multiple of {shares}"
        )
