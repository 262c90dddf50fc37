"""Settings of pre-training, from a YAML file and ``key=value`` overrides."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, Self

import yaml
from pydantic import BaseModel, Field, NonNegativeInt, PositiveFloat, PositiveInt, ValidationError, model_validator

from bathyscope.errors import SettingsError
from bathyscope_train.losses.supervised import LossWeights


class SourceSettings(BaseModel, frozen=True, extra="forbid"):
    """One folder of rendered clips, and when it is used."""

    folder: Path
    share: PositiveFloat = Field(default=1.0, description="Relative share of the windows once it is in use.")
    start: float = Field(default=0.0, ge=0, lt=1, description="Progress of training from which it is used.")


class PretrainSettings(BaseModel, frozen=True, extra="forbid"):
    """Supervised pre-training on rendered clips; not in the paper, which starts from published weights."""

    preset: str = "tiny"
    data: tuple[SourceSettings, ...] = Field(min_length=1)
    validation: tuple[Path, ...] = Field(default=(), description="Folders of held-out clips, rendered or measured.")
    validation_clips: PositiveInt = Field(default=8, description="Clips taken from each validation folder.")
    out: Path
    initial: Path | None = Field(default=None, description="Checkpoint (safetensors) to start from.")
    only: str = Field(default="", description="Train only parameters whose names start so, as gaussian_param_head.")
    minutes: PositiveFloat = Field(default=30.0, description="Wall-clock budget; the learning rate follows it.")
    steps: PositiveInt | None = Field(default=None, description="Budget in steps instead: the same bits for a seed.")
    seed: NonNegativeInt = 0
    workers: PositiveInt = Field(default=1, description="Processes that each take a share of every batch.")
    threads: PositiveInt = Field(default=1, description="Threads of each process.")
    precision: Literal["float32", "bfloat16", "auto"] = Field(
        default="float32", description="Of the transformer; auto asks the CPU."
    )
    batch: PositiveInt = Field(default=2, description="Windows a step, over all workers.")
    frames: PositiveInt = Field(default=8, description="Frames of a window.")
    pairs: PositiveInt = Field(default=16, description="Supervised motions a window.")
    peak_lr: PositiveFloat = 1e-3
    warmup_steps: NonNegativeInt = 60
    true_focal_steps: NonNegativeInt = Field(
        default=150, description="Then the solver gets the predicted one at times."
    )
    weight_decay: PositiveFloat = 0.02
    clip_norm: PositiveFloat = 1.0
    ema_decay: float = Field(default=0.998, ge=0, lt=1)
    validate_minutes: PositiveFloat = 4.0
    checkpoint_minutes: PositiveFloat = 2.0
    loss: LossWeights = LossWeights()

    @model_validator(mode="after")
    def _parts_fit(self) -> Self:
        if self.batch % self.workers:
            raise ValueError(f"a batch of {self.batch} cannot be shared evenly by {self.workers} workers")
        if min(source.start for source in self.data) > 0:
            raise ValueError("one of the data folders must start at 0")
        if self.frames <= 4:
            raise ValueError(f"windows need more than 4 frames for their widest pairs, got {self.frames}")
        return self


def load_settings(path: Path, overrides: Sequence[str] = ()) -> PretrainSettings:
    """Settings from a YAML file; an override ``name=value`` replaces a field, ``loss.name=value`` one inside it.

    ``data`` and ``validation`` may be one folder, or several with commas between them.

    Raises:
        SettingsError: If the file or an override cannot be read, or settings contradict each other.
    """
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    except (OSError, yaml.YAMLError) as error:
        raise SettingsError(f"{path}: cannot read settings: {error}") from error
    if not isinstance(values, dict):
        raise SettingsError(f"{path}: settings must be a mapping, got {type(values).__name__}")
    for override in overrides:
        _apply(values, override)
    for name, as_source in (("data", True), ("validation", False)):
        if isinstance(values.get(name), str):
            folders = values[name].split(",")
            values[name] = [{"folder": folder} for folder in folders] if as_source else folders
    try:
        return PretrainSettings(**values)
    except ValidationError as error:
        raise SettingsError(f"{path}: {error}") from error


def _apply(values: dict[str, Any], override: str) -> None:
    name, separator, text = override.partition("=")
    if not separator or not name:
        raise SettingsError(f"override {override!r} is not of the form name=value")
    *parents, leaf = name.split(".")
    for parent in parents:
        values = values.setdefault(parent, {})
    values[leaf] = yaml.safe_load(text)
