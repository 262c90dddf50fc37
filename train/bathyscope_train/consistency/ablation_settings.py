"""Settings of an experiment: the same run with and without each term, over several seeds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, Field, NonNegativeInt, PositiveInt, ValidationError

from bathyscope.errors import SettingsError
from bathyscope_train.consistency.settings import ConsistencySettings, parse_consistency_settings
from bathyscope_train.settings_files import read_settings_file, replace_setting

TASK = "ablation"


class AblationSettings(BaseModel, frozen=True, extra="forbid"):
    """What is compared, and on what it is measured."""

    task: Literal["ablation"] = "ablation"
    run: dict[str, Any] = Field(description="Settings of every run, as in a file with task: consistency.")
    variants: dict[str, dict[str, Any]] = Field(
        min_length=1, description="What each variant changes: values by dotted names, as loss.world.weight."
    )
    seeds: tuple[NonNegativeInt, ...] = Field(default=(0, 1, 2, 3, 4), min_length=1)
    target: Path = Field(description="Held-out clips, with ground truth, of the domain that is trained on.")
    source: Path | None = Field(default=None, description="The same of the domain that the network comes from.")
    clips: PositiveInt = Field(default=32, description="Clips of each that are measured.")
    out: Path = Path("runs/ablation")

    def run_settings(self, variant: str, seed: int) -> ConsistencySettings:
        """Settings of one run; it validates on the target clips as it goes.

        Raises:
            SettingsError: If they are unknown, out of range or contradict each other.
        """
        values = _copied(self.run)
        for name, value in self.variants[variant].items():
            _set(values, name, value)
        values |= {"seed": seed, "out": self.out / run_name(variant, seed)}
        values.setdefault("cache", self.out / "survey")
        values.setdefault("validation", [self.target])
        return parse_consistency_settings(values, f"variant {variant!r}")


def run_name(variant: str, seed: int) -> str:
    """Folder of one run."""
    return f"{variant.replace(' ', '-').replace('/', '-')}-seed{seed}"


def load_ablation_settings(path: Path, overrides: Sequence[str] = ()) -> AblationSettings:
    """Settings from a YAML file; ``base`` names a file of settings for its runs, beside it.

    Overrides that are not fields of an experiment go to every run: ``init=CHECKPOINT data=FOLDER steps=50``.

    Raises:
        SettingsError: If a file or an override cannot be read, or a run's settings are not usable.
    """
    fields = {*AblationSettings.model_fields, "base"}
    own = [override for override in overrides if override.partition("=")[0].split(".")[0] in fields]
    values = read_settings_file(path, own)
    base = values.pop("base", None)
    run = read_settings_file(path.parent / base) if base is not None else {}
    for name, value in dict(values.get("run") or {}).items():
        _set(run, name, value)
    for override in overrides:
        if override not in own:
            replace_setting(run, override)
    if isinstance(values.get("seeds"), int):
        values["seeds"] = range(values["seeds"])
    try:
        settings = AblationSettings(**{**values, "run": run})
    except ValidationError as error:
        raise SettingsError(f"{path}: {error}") from error
    for variant in settings.variants:
        settings.run_settings(variant, settings.seeds[0])
    return settings


def _set(values: dict[str, Any], name: str, value: Any) -> None:
    *parents, leaf = name.split(".")
    for parent in parents:
        values = values.setdefault(parent, {})
    values[leaf] = {**values.get(leaf, {}), **value} if isinstance(value, dict) else value


def _copied(values: dict[str, Any]) -> dict[str, Any]:
    return {name: _copied(value) if isinstance(value, dict) else value for name, value in values.items()}
