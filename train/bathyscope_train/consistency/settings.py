"""Settings of the consistency optimisation; defaults follow the paper's implementation details."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import (
    BaseModel,
    Field,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    ValidationError,
    model_validator,
)

from bathyscope.errors import SettingsError
from bathyscope_train.consistency.terms import ObjectiveSettings
from bathyscope_train.data.clip_sources import ClipSource
from bathyscope_train.data.clip_windows import WindowSettings
from bathyscope_train.model.checkpoints import CheckpointPath
from bathyscope_train.settings_files import read_settings_file

TASK = "consistency"


class PartSettings(BaseModel, frozen=True, extra="forbid"):
    """How a part of the network is trained."""

    rate: NonNegativeFloat = Field(default=1.0, description="Times the learning rate; 0 keeps the part as it is.")
    after_warmup: bool = Field(default=False, description="Frozen while the learning rate warms up.")


def paper_parts() -> dict[str, PartSettings]:
    """Heads as the paper trains them.

    It multiplies the rate of "parameters" by 0.1. Read, as in AnySplat's own training, as those of all parts but the
    Gaussian head, the only one that AnySplat did not take over from an earlier network.
    """
    return {
        "depth_head": PartSettings(rate=0.1),
        "gaussian_param_head": PartSettings(),
        "camera_head": PartSettings(rate=0.1, after_warmup=True),
    }


class SafetySettings(BaseModel, frozen=True, extra="forbid"):
    """When a run is stopped; not in the paper."""

    least_variation: float = Field(
        default=0.5, ge=0, lt=1, description="Of depth within a frame, as a share of the network before training."
    )
    steps: PositiveInt = Field(default=20, description="Steps over which that is averaged.")
    skipped: PositiveInt = Field(default=5, description="Updates in a row without a finite gradient.")


class ConsistencySettings(BaseModel, frozen=True, extra="forbid"):
    """One run on videos without ground truth."""

    task: Literal["consistency"] = "consistency"
    data: tuple[ClipSource, ...] = Field(min_length=1)
    init: CheckpointPath = Field(
        description="Checkpoint to start from: `shipped`, one of ours, or published weights with `preset`."
    )
    preset: str | None = Field(default=None, description="Network of `init`; needed where the file does not say.")
    out: Path = Path("runs/consistency")
    cache: Path | None = Field(default=None, description="Keeps what the first pass over videos found; out/survey.")
    validation: tuple[Path, ...] = Field(default=(), description="Held-out folders with ground truth.")
    validation_clips: PositiveInt = 8
    validate_every: NonNegativeInt = Field(default=1000, description="Steps between evaluations; 0 for none.")

    steps: PositiveInt = 20_000
    warmup_steps: NonNegativeInt = 2_000
    peak_lr: PositiveFloat = 2e-4
    final_lr: float = Field(default=0.0, ge=0, le=1, description="Share of the peak at the end of the cosine.")
    parts: dict[str, PartSettings] = Field(
        default_factory=paper_parts, description="By the beginning of parameter names; what is not named is frozen."
    )
    weight_decay: NonNegativeFloat = Field(default=0.01, description="Of AdamW. Not in the paper.")
    betas: tuple[float, float] = Field(default=(0.9, 0.999), description="Of AdamW. Not in the paper.")
    clip_norm: PositiveFloat = Field(default=1.0, description="Largest norm of the gradient. Not in the paper.")
    ema_decay: float = Field(default=0.0, ge=0, lt=1, description="Of a running average of the weights; 0 for none.")
    batch: PositiveInt = Field(default=1, description="Windows of an update, over all processes.")
    accumulate: PositiveInt = Field(default=1, description="Parts in which a process works through its windows.")

    window: WindowSettings = WindowSettings()
    loss: ObjectiveSettings = ObjectiveSettings()
    balance_steps: NonNegativeInt = Field(
        default=0, description="Steps measured beforehand, to read the weights as shares of the sum. Not in the paper."
    )
    cameras: Literal["given", "before", "through"] = Field(
        default="given",
        description="While the camera head is frozen: what it says of depth as it is now, taken as given; what it said "
        "before training; or differentiated through.",
    )
    cameras_from: str | None = Field(
        default=None,
        description="For a network without cameras: a checkpoint of ours, EndoDAC's folder, or `data` for the poses "
        "that come with the videos.",
    )
    nominal_depth: PositiveFloat | None = Field(
        default=None, description="For such a network and `cameras_from=data`: median depth in the unit of the poses."
    )
    known_focal: bool = Field(default=False, description="Tell the network the focal length where the data has it.")

    seed: NonNegativeInt = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    precision: Literal["auto", "float32", "bfloat16"] = Field(
        default="auto", description="Of the transformer; auto takes bfloat16 on CUDA and CPUs with matrix units."
    )
    threads: PositiveInt | None = Field(default=None, description="Of torch; as torch chooses unless given.")
    loaders: NonNegativeInt = Field(default=2, description="Processes that read frames; 0 reads them in between.")
    checkpoint_activations: bool = Field(default=False, description="Less memory for more time.")
    dense_chunk: PositiveInt | None = Field(
        default=None, description="Frames the dense heads work on at once, each chunk worked out again going back."
    )
    checkpoint_every: PositiveInt = Field(default=500, description="Steps between checkpoints.")
    keep_checkpoints: int = Field(default=2, ge=1)
    log_every: PositiveInt = 10
    tensorboard: bool = True
    pictures_every: PositiveInt = Field(default=500, description="Steps between picture grids.")
    safety: SafetySettings = SafetySettings()

    @model_validator(mode="after")
    def _parts_fit(self) -> Self:
        if self.window.frames < self.loss.least_frames:
            raise ValueError(
                f"windows of {self.window.frames} frames hold no pair for the losses' strides, which need "
                f"{self.loss.least_frames}; make window.frames larger or loss.world.stride and loss.temporal.stride "
                "smaller"
            )
        if self.warmup_steps >= self.steps:
            raise ValueError(f"a warm-up of {self.warmup_steps} steps does not fit into {self.steps}")
        if not any(weight > 0 for weight in self.loss.weights.values()):
            raise ValueError("all terms have a weight of 0; nothing would be trained")
        if not any(part.rate > 0 for part in self.parts.values()):
            raise ValueError("all parts have a rate of 0; nothing would be trained")
        return self


def load_consistency_settings(path: Path, overrides: Sequence[str] = ()) -> ConsistencySettings:
    """Settings from a YAML file and overrides; see :func:`parse_consistency_settings`."""
    return parse_consistency_settings(read_settings_file(path, overrides), str(path))


def parse_consistency_settings(values: Mapping[str, Any], where: str) -> ConsistencySettings:
    """Settings from a mapping; ``data`` and ``validation`` may be one folder, or several with commas between them.

    Raises:
        SettingsError: If settings are unknown, out of range or contradict each other.
    """
    chosen = dict(values)
    if isinstance(chosen.get("data"), str):
        chosen["data"] = [{"folder": folder} for folder in chosen["data"].split(",")]
    if isinstance(chosen.get("validation"), str):
        chosen["validation"] = chosen["validation"].split(",")
    missing = [name for name, example in (("data", "FOLDER"), ("init", "CHECKPOINT")) if not chosen.get(name)]
    if missing:
        needed = " ".join(f"{name}={'FOLDER' if name == 'data' else 'CHECKPOINT'}" for name in missing)
        raise SettingsError(f"{where}: says nothing about {' and '.join(missing)}; add {needed}")
    try:
        return ConsistencySettings(**chosen)
    except ValidationError as error:
        raise SettingsError(f"{where}: {error}") from error
