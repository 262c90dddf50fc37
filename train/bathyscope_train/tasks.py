"""What a settings file asks ``bathyscope train`` to do."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bathyscope.errors import SettingsError
from bathyscope_train.config import PretrainSettings, load_settings
from bathyscope_train.consistency.ablation_settings import AblationSettings, load_ablation_settings
from bathyscope_train.consistency.settings import ConsistencySettings, load_consistency_settings
from bathyscope_train.settings_files import read_settings_file

KINDS = ("pretrain", "consistency", "ablation")
Settings = PretrainSettings | ConsistencySettings | AblationSettings

_FIELDS = {
    "pretrain": frozenset(PretrainSettings.model_fields),
    "consistency": frozenset(ConsistencySettings.model_fields),
    "ablation": frozenset((*AblationSettings.model_fields, "base")),
}


def load_task(path: Path, overrides: Sequence[str] = ()) -> Settings:
    """The settings of a file, of the kind that its ``task`` names, or whose settings it holds.

    Raises:
        SettingsError: If the kind cannot be told, or the settings are not usable.
    """
    kind = task_of(path)
    if kind == "consistency":
        return load_consistency_settings(path, overrides)
    if kind == "ablation":
        return load_ablation_settings(path, overrides)
    return load_settings(path, overrides)


def task_of(path: Path) -> str:
    """``pretrain``, ``consistency`` or ``ablation``.

    Raises:
        SettingsError: If the file names another task, or names none and its settings belong to no one kind.
    """
    values = read_settings_file(path)
    if "task" in values:
        if values["task"] not in KINDS:
            raise SettingsError(f"{path}: task is {values['task']!r}; known are {', '.join(KINDS)}")
        return str(values["task"])
    fitting = [kind for kind in KINDS if values.keys() <= _FIELDS[kind]]
    if len(fitting) == 1 or fitting[:1] == ["pretrain"]:
        return fitting[0]
    foreign = {kind: sorted(values.keys() - _FIELDS[kind]) for kind in KINDS}
    nearest = min(KINDS, key=lambda kind: len(foreign[kind]))
    raise SettingsError(
        f"{path}: cannot tell what to do; say task: with one of {', '.join(KINDS)}. Nearest is {nearest!r}, which has "
        f"no {', '.join(foreign[nearest]) or 'settings of its own here'}"
    )
