"""What a pre-trained checkpoint says about its making: settings, clips, and what it began with."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from bathyscope_train.config import PretrainSettings
from bathyscope_train.data.synthetic.shards import clip_paths
from bathyscope_train.model.checkpoints import training_of


def training_record(settings: PretrainSettings) -> dict[str, Any]:
    """The settings, with the names of folders but not where they lay."""
    record: dict[str, Any] = json.loads(settings.model_dump_json(exclude={"out"}))
    for source in record["data"]:
        for kind in ("folder", "domain"):
            source[kind] = Path(source[kind]).name if source[kind] else None
    record["validation"] = [Path(folder).name for folder in record["validation"]]
    for file in ("initial", "encoder"):
        record[file] = Path(record[file]).name if record[file] else None
    return record


def making_of(settings: PretrainSettings) -> dict[str, Any]:
    """What stays the same while it trains: settings, clips, digest of the encoder, how initial weights were made."""
    found: dict[str, Any] = {"settings": training_record(settings), "clips": _clips(settings)}
    if settings.encoder is not None:
        found["encoder_sha256"] = hashlib.sha256(settings.encoder.read_bytes()).hexdigest()
    before = training_of(settings.initial) if settings.initial is not None else {}
    return {**found, "began_with": before} if before else found


def _clips(settings: PretrainSettings) -> dict[str, str]:
    """Number and seeds of the clips of each folder; their names are their seeds."""
    found = {}
    for source in settings.data:
        if source.folder is None:
            continue
        seeds = [int(path.stem) for path in clip_paths(source.folder) if path.stem.isdigit()]
        if seeds:
            found[source.folder.name] = f"{len(seeds)} clips, seeds {min(seeds)} to {max(seeds)}"
    return found
