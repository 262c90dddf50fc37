"""What a run writes about itself, and whether a folder holds the run that is asked for."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from bathyscope.errors import SettingsError
from bathyscope_train.consistency.checkpoint_folder import checkpoint_folders
from bathyscope_train.consistency.settings import ConsistencySettings

SETTINGS_FILE = "settings.json"
FREE = frozenset(
    (
        "out",
        "cache",
        "validation",
        "validation_clips",
        "validate_every",
        "device",
        "threads",
        "loaders",
        "checkpoint_activations",
        "dense_chunk",
        "checkpoint_every",
        "keep_checkpoints",
        "log_every",
        "tensorboard",
        "pictures_every",
        "safety",
    )
)
"""Settings that may change when a run goes on: none of them changes what is learnt, but for rounding."""


def check_same_run(settings: ConsistencySettings) -> None:
    """Refuse to go on in a folder with a run of other settings.

    Raises:
        SettingsError: If there is one; names what differs.
    """
    path = settings.out / SETTINGS_FILE
    if not path.is_file() or not checkpoint_folders(settings.out):
        return
    before, now = json.loads(path.read_text(encoding="utf-8")), json.loads(settings.model_dump_json())
    names = sorted(name for name in before.keys() | now.keys() if name not in FREE)
    changed = [
        f"{name} {before.get(name)!r}, now {now.get(name)!r}" for name in names if before.get(name) != now.get(name)
    ]
    if changed:
        raise SettingsError(
            f"{settings.out}: holds a run with other settings ({'; '.join(changed[:4])}); "
            "name another folder with out=FOLDER, or remove this one"
        )


def write_settings(settings: ConsistencySettings) -> None:
    """Write the resolved settings beside and rename them into place."""
    settings.out.mkdir(parents=True, exist_ok=True)
    beside = settings.out / f".{SETTINGS_FILE}"
    beside.write_text(settings.model_dump_json(indent=1), encoding="utf-8")
    beside.replace(settings.out / SETTINGS_FILE)


def training_record(settings: ConsistencySettings, step: int) -> dict[str, Any]:
    """What a checkpoint says about its making: settings, with the names of folders but not where they lay."""
    record: dict[str, Any] = json.loads(settings.model_dump_json(exclude={"out", "cache"}))
    for source in record["data"]:
        source["folder"] = Path(source["folder"]).name
    record["validation"] = [Path(folder).name for folder in record["validation"]]
    record["init"] = Path(record["init"]).name
    return {"step": step, "settings": record, "finished_at": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())}
