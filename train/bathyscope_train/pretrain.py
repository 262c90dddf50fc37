"""Supervised pre-training on rendered clips: depth, cameras and Gaussians from nothing."""

import json
import logging
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from bathyscope.errors import SettingsError
from bathyscope_train.config import PretrainSettings
from bathyscope_train.curves import draw_curves
from bathyscope_train.data.measured_clips import read_measured_clips
from bathyscope_train.data.truth_clips import read_truth_clips
from bathyscope_train.data.window_sources import WindowSources
from bathyscope_train.data.windows import TruthClip
from bathyscope_train.devices import choose_device, use_bfloat16
from bathyscope_train.losses.supervised import SolverInput, supervised_objective
from bathyscope_train.metrics_file import METRICS_FILE, drop_after
from bathyscope_train.model.checkpoints import load_network, save_checkpoint
from bathyscope_train.model.lite0 import Lite0Encoder
from bathyscope_train.model.matching_camera_head import MatchingCameraHead
from bathyscope_train.model.network import Network
from bathyscope_train.model.presets import get_preset
from bathyscope_train.model.stem import EncodedStem
from bathyscope_train.model.trajectory import ClipPairs, clip_pairs
from bathyscope_train.pretrain_record import making_of
from bathyscope_train.schedule import ema_decay, learning_rate_factor
from bathyscope_train.training_state import read_state, write_state
from bathyscope_train.validation import Validation, validate, write_grid
from bathyscope_train.workers import average, launch, share_gradients

LOG_STEPS = 10
WEIGHTS_FILE = "model.safetensors"

ENCODER = "aggregator.patch_embed.encoder."
"""What names of parameters of a pre-trained encoder begin with."""

_FOCAL_ERROR = 0.15  # standard deviation of the logarithm
_HINT_ERROR = 0.3

_log = logging.getLogger(__name__)


def pretrain(settings: PretrainSettings) -> Path:
    """Train, or go on with the run in ``settings.out``; returns the path of the weights (their running average).

    The folder gets ``model.safetensors``, ``state.pt`` (to go on), ``metrics.jsonl``, ``settings.json`` and, at every
    validation, ``validation.png`` and ``curves.png``.

    Raises:
        SettingsError: If the preset cannot be trained this way.
        DatasetError: If a folder holds no clips.
    """
    settings.out.mkdir(parents=True, exist_ok=True)
    (settings.out / "settings.json").write_text(settings.model_dump_json(indent=2), encoding="utf-8")
    launch(partial(_work, settings), settings.workers)
    return settings.out / WEIGHTS_FILE


def _work(settings: PretrainSettings, rank: int) -> None:
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    torch.set_num_threads(settings.threads)
    _Run(settings, rank).train()


class _Run:
    """One worker's side of a training run."""

    def __init__(self, settings: PretrainSettings, rank: int) -> None:
        self.settings, self.rank = settings, rank
        self.device = choose_device(settings.device, workers=settings.workers)
        self.network = initial_network(settings).to(self.device)
        self.average = {name: value.detach().clone() for name, value in self.network.state_dict().items()}
        self.parameters = choose_parameters(self.network, settings.only)
        self.optimizer = torch.optim.AdamW(parameter_groups(self.network, settings), betas=(0.9, 0.98))
        self.position = read_state(settings.out, self.network, self.average, self.optimizer)
        if rank == 0:
            drop_after(settings.out / METRICS_FILE, self.position.step)
        self.sources = WindowSources(
            settings.data, settings.render, device=self.device, seed=settings.seed, step=self.position.step
        )
        self.held_out = [held_out_clips(path, settings.validation_clips) for path in settings.validation]
        self.making = making_of(settings)
        self.started = time.monotonic() - self.position.elapsed_s
        self.recent: list[Tensor] = []

    def train(self) -> None:
        """Take steps until the budget is used up."""
        validated = saved = time.monotonic()
        progress = self.progress()
        begun = time.monotonic()
        while progress < 1 and not self.slice_is_over(begun):
            progress = self.step(progress)
            now = time.monotonic()
            if self.rank == 0 and now - saved > 60 * self.settings.checkpoint_minutes:
                self.save()
                saved = now
            if self.rank == 0 and self.held_out and now - validated > 60 * self.settings.validate_minutes:
                self.validate()
                validated = time.monotonic()
        self.sources.close()
        if self.rank == 0:
            self.save()
            if self.held_out:
                self.validate()

    def slice_is_over(self, begun: float) -> bool:
        """Whether this process has had its time; the same answer in all workers is what one worker is for."""
        limit = self.settings.slice_minutes
        return limit is not None and time.monotonic() - begun > 60 * limit

    def progress(self) -> float:
        """Share of the budget that is used up."""
        if self.settings.steps is not None:
            return self.position.step / self.settings.steps
        return (time.monotonic() - self.started) / (60 * self.settings.minutes)

    def step(self, progress: float) -> float:
        """One optimiser step; returns the new progress, the same in all workers."""
        settings, step = self.settings, self.position.step
        random = np.random.default_rng([settings.seed, step, self.rank])
        batch = self.sources.draw(progress, random, settings.batch // settings.workers, frames=settings.frames)
        pairs = draw_pairs(settings.frames, settings.pairs, random, self.device)
        given = draw_solver_input(random, settings.frames, certain=step < settings.true_focal_steps)
        self.network.train()
        self.optimizer.zero_grad(set_to_none=True)
        objective = supervised_objective(
            self.network, batch, pairs, settings.loss, given, autocast=use_bfloat16(settings.precision, self.device)
        )
        objective.total.backward()
        self.position.step += 1
        progress = share_gradients(self.parameters, self.progress())
        norm = torch.nn.utils.clip_grad_norm_(self.parameters, settings.clip_norm)
        factor = learning_rate_factor(step, progress, warmup_steps=settings.warmup_steps)
        for group in self.optimizer.param_groups:
            group["lr"] = settings.peak_lr * factor * group["share"]
        if bool(norm.isfinite()):
            self.optimizer.step()
        else:
            _log.warning("step %d: gradient is not finite; step left out", step)
        self.update_average(step)
        self.report(objective.terms, norm, factor, progress)
        return progress

    def update_average(self, step: int) -> None:
        """Move the running average of the weights."""
        decay = ema_decay(step, self.settings.ema_decay)
        for name, value in self.network.state_dict().items():
            self.average[name].lerp_(value, 1 - decay)

    def report(self, terms: dict[str, Tensor], norm: Tensor, factor: float, progress: float) -> None:
        """Every few steps, a line with the means of the terms since the last one."""
        self.recent.append(torch.stack([*(term.detach() for term in terms.values()), norm.detach()]))
        if len(self.recent) < LOG_STEPS:
            return
        means = average(torch.stack(self.recent).mean(0))
        self.recent.clear()
        if self.rank == 0:
            names = [*terms, "gradient_norm"]
            values = {name: round(float(value), 5) for name, value in zip(names, means, strict=True)}
            self.write({"progress": round(progress, 4), "rate": factor, **values})

    def validate(self) -> None:
        """Measure the running average on the held-out clips."""
        network = self.averaged()
        examples = []
        for folder, clips in zip(self.settings.validation, self.held_out, strict=True):
            result, pictures = validate(network, clips, frames=self.settings.frames)
            self.write({"validation": folder.name, **json.loads(result.as_json())})
            _log.info("step %d, %s: %s", self.position.step, folder.name, summary(result))
            examples += pictures[:6]
        write_grid(self.settings.out / "validation.png", examples)
        draw_curves(self.settings.out / METRICS_FILE, self.settings.out / "curves.png")

    def averaged(self) -> Network:
        """The network with the running average of the weights."""
        network = Network(self.network.preset)
        network.load_state_dict(self.average)
        return network.eval()

    def save(self) -> None:
        """Write weights and state."""
        self.position.elapsed_s = time.monotonic() - self.started
        training = {"step": self.position.step, **self.making}
        save_checkpoint(self.averaged(), self.settings.out / WEIGHTS_FILE, training=training)
        write_state(self.settings.out, self.network, self.average, self.optimizer, self.position)

    def write(self, values: dict[str, Any]) -> None:
        """Append a line to the metrics."""
        line = {"step": self.position.step, "elapsed_s": round(time.monotonic() - self.started, 1), **values}
        with (self.settings.out / METRICS_FILE).open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")


def initial_network(settings: PretrainSettings) -> Network:
    """A fresh network, the same for the same seed, or the one in ``settings.initial``.

    Raises:
        SettingsError: If the network's camera head cannot be supervised by matches.
    """
    torch.manual_seed(settings.seed)
    network = load_network(settings.initial)[0] if settings.initial else Network(get_preset(settings.preset))
    if settings.encoder is not None:
        _encoder(network).load_published(settings.encoder)
    if not isinstance(network.camera_head, MatchingCameraHead):
        raise SettingsError(
            f"preset {network.preset.name!r} has no matching camera head; pre-training needs one, as in 'tiny'"
        )
    return network if settings.flow_noise is None else _holding_back(network, settings.flow_noise)


def _holding_back(network: Network, flow_noise: float) -> Network:
    """The same weights with another prior on motion."""
    camera = network.preset.camera.model_copy(update={"flow_noise": flow_noise})
    changed = Network(network.preset.model_copy(update={"camera": camera}))
    changed.load_state_dict(network.state_dict())
    return changed


def _encoder(network: Network) -> Lite0Encoder:
    stem = network.aggregator.patch_embed
    if not isinstance(stem, EncodedStem):
        raise SettingsError(f"preset {network.preset.name!r} has no encoder; give preset=tiny-lite0, or no encoder")
    return stem.encoder


def held_out_clips(folder: Path, count: int) -> list[TruthClip]:
    """Clips of a validation folder: rendered ones, or those of a measured data set folder."""
    if (folder / "frames").is_dir():
        return read_measured_clips(folder, limit=count)
    return read_truth_clips(folder, limit=count)


def choose_parameters(network: Network, prefix: str) -> list[nn.Parameter]:
    """The parameters whose names start with ``prefix``; all others are frozen.

    Raises:
        SettingsError: If there is none.
    """
    for name, parameter in network.named_parameters():
        parameter.requires_grad_(name.startswith(prefix))
    chosen = [parameter for parameter in network.parameters() if parameter.requires_grad]
    if not chosen:
        raise SettingsError(f"no parameter of {network.preset.name!r} starts with {prefix!r}")
    return chosen


def parameter_groups(network: Network, settings: PretrainSettings) -> list[dict[str, Any]]:
    """Weight decay for matrices and kernels, none for biases, norms and tokens; a pre-trained encoder learns slower."""
    groups: dict[tuple[bool, bool], list[nn.Parameter]] = {}
    for name, parameter in network.named_parameters():
        if parameter.requires_grad:
            decayed = parameter.ndim >= 2 and "token" not in name
            groups.setdefault((name.startswith(ENCODER), not decayed), []).append(parameter)
    return [
        {
            "params": parameters,
            "weight_decay": 0.0 if plain else settings.weight_decay,
            "share": settings.encoder_rate if encoder else 1.0,
            "lr": settings.peak_lr,
        }
        for (encoder, plain), parameters in sorted(groups.items(), key=lambda item: item[0])
    ]


def draw_pairs(frames: int, count: int, random: np.random.Generator, device: torch.device | None = None) -> ClipPairs:
    """Some of the pairs whose motions the trajectory uses, without repetition."""
    every = clip_pairs(frames)
    usable = np.flatnonzero(every.inside.numpy())
    chosen = torch.from_numpy(np.sort(random.permutation(usable)[:count]))
    return ClipPairs(*(values[chosen].to(device) for values in (every.source, every.target, every.inside)))


def draw_solver_input(random: np.random.Generator, frames: int, *, certain: bool) -> SolverInput:
    """What the solver starts from (in half of the steps, and while ``certain``, the truth), and the frame left out."""
    focal, motion, hint = random.random(3) < 0.5
    error = float(np.exp(random.normal(0, _FOCAL_ERROR)))
    return SolverInput(
        true_focal=bool(certain or focal),
        focal_error=error,
        true_motion=bool(certain or motion),
        hint_error=float(random.uniform(0, _HINT_ERROR)) if hint else None,
        hint_seed=int(random.integers(2**31)),
        held_out=int(random.integers(frames)),
    )


def summary(result: Validation) -> str:
    """One line for a person."""
    return (
        f"AbsRel {result.abs_rel:.3f} (constant {result.constant:.3f}, best map {result.best_map:.3f}), "
        f"d1 {result.delta1:.3f}, rotation {result.rotation_deg:.2f} of {result.rotation_true_deg:.2f} deg, "
        f"direction {result.direction_cosine:.3f}, focal {result.focal_ratio:.2f}"
    )
