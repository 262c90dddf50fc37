"""What a first pass over a video found, and the file that keeps it for the next run."""

from __future__ import annotations

import hashlib
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, PositiveFloat, PositiveInt

from bathyscope.camera import Size
from bathyscope.vision.cuts import CutSettings
from bathyscope.vision.field_of_view import FieldOfView
from bathyscope_train.data.datasets.sequence import DataSequence

_FORMAT = 1


class SurveySettings(BaseModel, frozen=True, extra="forbid"):
    """What counts as usable; none of it is in the paper."""

    pixels: PositiveInt = Field(default=9600, description="Area of the small pictures.")
    still: PositiveFloat = Field(default=0.0008, description="Motion, as a share of the width, that is no motion.")
    cuts: CutSettings = CutSettings()


@dataclass(frozen=True, slots=True)
class ClipSurvey:
    """What a video holds."""

    name: str
    size: Size
    """(height, width) of the frames that are used."""
    view: FieldOfView
    kept: NDArray[np.intp]
    """(k,) numbers of the frames that are used."""
    motion: NDArray[np.float64]
    """(k,) how far each has moved from the one before it, as a share of the width; 0 where a shot begins."""
    shots: NDArray[np.intp]
    """(s + 1,) where in ``kept`` each shot begins, and its end."""
    notes: tuple[str, ...]
    """What was left out, in words."""


def survey_fingerprint(sequence: DataSequence, settings: SurveySettings) -> str:
    """Changes with the files, their state, and the settings."""
    digest = hashlib.sha256(f"{_FORMAT} {sequence.name} {sequence.size} {settings.model_dump_json()}".encode())
    for name in sequence.frame_names:
        digest.update(name.encode())
    for path in sequence.frames.files():
        state = path.stat() if path.is_file() else None
        digest.update(f"{path.name} {state and (state.st_size, state.st_mtime_ns)}\n".encode())
    if sequence.inside is not None:
        digest.update(np.packbits(sequence.inside).tobytes())
    return digest.hexdigest()[:24]


def write_survey(path: Path, survey: ClipSurvey) -> None:
    """Write beside and rename into place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}")
    about = {"name": survey.name, "size": survey.size, "shape": survey.view.shape, "notes": survey.notes}
    with beside.open("wb") as file:
        np.savez(
            file,
            about=np.array(json.dumps(about)),
            inside=np.packbits(survey.view.mask),
            kept=survey.kept,
            motion=survey.motion,
            shots=survey.shots,
        )
    beside.replace(path)


def read_survey(path: Path) -> ClipSurvey | None:
    """What an earlier run found; ``None`` where the file is damaged, so that it is made again."""
    try:
        with np.load(path, allow_pickle=False) as file:
            about: dict[str, Any] = json.loads(str(file["about"]))
            height, width = about["size"]
            inside = np.unpackbits(file["inside"], count=height * width).astype(np.bool_).reshape(height, width)
            return ClipSurvey(
                name=about["name"],
                size=(height, width),
                view=FieldOfView(inside, about["shape"]),
                kept=file["kept"],
                motion=file["motion"],
                shots=file["shots"],
                notes=tuple(about["notes"]),
            )
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
