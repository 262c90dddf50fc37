"""Settings of pre-training, from a YAML file and ``key=value`` overrides."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, Self

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
from bathyscope_train.losses.supervised import LossWeights
from bathyscope_train.model.checkpoints import CheckpointPath
from bathyscope_train.settings_files import read_settings_file


class SourceSettings(BaseModel, frozen=True, extra="forbid"):
    """One folder of rendered clips, or a domain that is rendered while it trains; and when it is used."""

    folder: Path | None = None
    domain: str | None = Field(default=None, description="Instead of a folder: a named domain, or a JSON file of one.")
    share: PositiveFloat = Field(default=1.0, description="Relative share of the windows once it is in use.")
    start: float = Field(default=0.0, ge=0, lt=1, description="Progress of training from which it is used.")

    @model_validator(mode="after")
    def _one_of_two(self) -> Self:
        if (self.folder is None) == (self.domain is None):
            raise ValueError("a source is either a folder or a domain")
        return self


class RenderSettings(BaseModel, frozen=True, extra="forbid"):
    """Clips that are rendered while it trains, on the device where it trains; of each domain a pool of them."""

    frames: PositiveInt = Field(default=16, description="Length of a clip.")
    height: PositiveInt = 112
    width: PositiveInt = 140
    pool: PositiveInt = Field(default=64, description="Clips from which windows are drawn.")
    fresh: PositiveInt = Field(default=2, description="Clips that are replaced by new ones at every step.")
    takes: PositiveInt = Field(default=4, description="Clips of one scene, each with its own camera, light and sensor.")
    compiled: bool = Field(default=False, description="Trace and shade by compiled code; takes a minute to start.")
    processes: NonNegativeInt = Field(default=1, description="Processes that draw scenes; 0 draws them in between.")

    @model_validator(mode="after")
    def _fits_the_pool(self) -> Self:
        if self.fresh > self.pool:
            raise ValueError(f"a step replaces {self.fresh} clips, but the pool has {self.pool}")
        return self


class PretrainSettings(BaseModel, frozen=True, extra="forbid"):
    """Supervised pre-training on rendered clips; not in the paper, which starts from published weights."""

    task: Literal["pretrain"] = "pretrain"
    preset: str = "tiny"
    data: tuple[SourceSettings, ...] = Field(min_length=1)
    validation: tuple[Path, ...] = Field(default=(), description="Folders of held-out clips, rendered or measured.")
    validation_clips: PositiveInt = Field(default=8, description="Clips taken from each validation folder.")
    out: Path
    initial: CheckpointPath | None = Field(
        default=None, description="Checkpoint (safetensors) to start from; `shipped` for the one in the package."
    )
    encoder: Path | None = Field(
        default=None, description="Published EfficientNet-Lite0 weights, for a fresh network with that encoder."
    )
    encoder_rate: PositiveFloat = Field(default=0.1, description="Learning rate of that encoder over that of the rest.")
    flow_noise: NonNegativeFloat | None = Field(
        default=None, description="How far the camera head holds small motions back, instead of what the network says."
    )
    only: str = Field(default="", description="Train only parameters whose names start so, as gaussian_param_head.")
    minutes: PositiveFloat = Field(default=30.0, description="Wall-clock budget; the learning rate follows it.")
    steps: PositiveInt | None = Field(default=None, description="Budget in steps instead: the same bits for a seed.")
    slice_minutes: PositiveFloat | None = Field(
        default=None, description="Stop this process after so long; the next one goes on where it stopped."
    )
    seed: NonNegativeInt = 0
    device: Literal["auto", "cpu", "cuda"] = Field(default="auto", description="auto: cuda where there is one.")
    render: RenderSettings = RenderSettings()
    workers: PositiveInt = Field(default=1, description="Processes that each take a share of every batch.")
    threads: PositiveInt = Field(default=1, description="Threads of each process.")
    precision: Literal["float32", "bfloat16", "auto"] = Field(
        default="float32", description="Of the transformer; auto asks the device."
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
        if any(source.domain for source in self.data) and self.workers > 1:
            raise ValueError("domains that are rendered while it trains need one worker; render folders for several")
        if self.slice_minutes is not None and self.workers > 1:
            raise ValueError("a run of several workers cannot be cut into slices by time; use steps, or one worker")
        if self.device == "cuda" and self.workers > 1:
            raise ValueError(f"on cuda one worker trains, got {self.workers}")
        if self.encoder is not None and self.initial is not None:
            raise ValueError("encoder is for a fresh network; initial brings an encoder of its own")
        if self.frames <= 4:
            raise ValueError(f"windows need more than 4 frames for their widest pairs, got {self.frames}")
        return self


def load_settings(path: Path, overrides: Sequence[str] = ()) -> PretrainSettings:
    """Settings from a YAML file; an override ``name=value`` replaces a field, ``loss.name=value`` one inside it.

    ``data`` and ``validation`` may be one folder, or several with commas between them.

    Raises:
        SettingsError: If the file or an override cannot be read, or settings contradict each other.
    """
    values = read_settings_file(path, overrides)
    for name, as_source in (("data", True), ("validation", False)):
        if isinstance(values.get(name), str):
            folders = values[name].split(",")
            values[name] = [{"folder": folder} for folder in folders] if as_source else folders
    try:
        return PretrainSettings(**values)
    except ValidationError as error:
        raise SettingsError(f"{path}: {error}") from error
