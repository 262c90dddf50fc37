"""How numbers come about, as small declarative objects that a table prints in words beneath itself.

The defaults of :class:`Protocol` are the sound choices. What published evaluators do besides is a :class:`Quirk`, and
only happens when it is asked for by name (``--compat``).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from typing import Any, Literal, get_args

from bathyscope.errors import SettingsError
from bathyscope_train.evaluation.depth_alignment import ALIGNMENT_WORDS, AlignmentKind
from bathyscope_train.evaluation.resampling import RESIZE_WORDS, Resize

PAPER_COLUMNS = ("abs_rel", "sq_rel", "rmse", "rmse_log", "delta1")
"""The five numbers of the paper's tables, in their order."""
SEVEN_COLUMNS = (*PAPER_COLUMNS, "delta2", "delta3")
Averaging = Literal["sequences", "frames"]
AVERAGING_WORDS: dict[Averaging, str] = {
    "sequences": "mean over the frames of a sequence, then plain mean over sequences",
    "frames": "mean over all frames of all sequences in one pool, so long sequences weigh more",
}


class Quirk(StrEnum):
    """What a published evaluator does and ours does not unless asked."""

    HOLES_CLIPPED = "holes-clipped"
    FIXED_CAMERA = "fixed-camera"
    LAST_POINT = "last-point"
    SHIFTED_PIXELS = "shifted-pixels"
    WHOLE_PIXELS = "whole-pixels"
    UNGUARDED = "unguarded"
    STUDENT_T = "student-t"
    DISPARITY_FLOOR = "disparity-floor"


QUIRK_WORDS: dict[Quirk, str] = {
    Quirk.HOLES_CLIPPED: "pixels without a prediction count as the nearest depth of the caps",
    Quirk.FIXED_CAMERA: "temporal errors use fx = 0.82 W, fy = 1.02 H for every camera",
    Quirk.LAST_POINT: "where warped points meet, the last one in scan order wins, not the nearest",
    Quirk.SHIFTED_PIXELS: "warped points are rounded without removing the half pixel that was added",
    Quirk.WHOLE_PIXELS: "centres of pixels lie at whole numbers when points are warped",
    Quirk.UNGUARDED: "one pair without truth makes the mean of TAE and TAS NaN",
    Quirk.STUDENT_T: "intervals are Student's t over frames, as if frames were independent",
    Quirk.DISPARITY_FLOOR: "predicted disparity is clipped from below at 0.001 before the fit",
}
COMPATIBLE: dict[str, frozenset[Quirk]] = {
    "endodav": frozenset(
        {Quirk.HOLES_CLIPPED, Quirk.FIXED_CAMERA, Quirk.LAST_POINT, Quirk.SHIFTED_PIXELS, Quirk.UNGUARDED}
        | {Quirk.STUDENT_T}
    ),
    "endodac": frozenset({Quirk.HOLES_CLIPPED, Quirk.STUDENT_T}),
    "vda": frozenset({Quirk.DISPARITY_FLOOR, Quirk.LAST_POINT, Quirk.WHOLE_PIXELS}),
}
"""All quirks of one public evaluator by its name."""


@dataclass(frozen=True, slots=True)
class Protocol:
    """One way to turn predictions and truth into a table."""

    name: str
    source: str
    """Who evaluates like this, for people."""
    alignment: AlignmentKind = "scale"
    per: Literal["sequence", "frame"] = "sequence"
    """Whether one alignment serves a whole sequence or each frame has its own."""
    averaging: Averaging = "sequences"
    caps_mm: tuple[float, float] | None = None
    """True depths that count, bounds excluded, and to which aligned depth is clipped; the data set's unless given."""
    resize: Resize = "as_given"
    crop: bool = False
    """Whether the data set's published crop is cut out of images and truth."""
    intrinsics: Literal["unknown", "known"] = "unknown"
    """Whether systems are told the camera matrix of a sequence; those that cannot use it ignore it."""
    temporal: Literal["endodav", "vda"] | None = "endodav"
    """Which temporal error to report where poses are known."""
    scared_split: Literal["video-test", "endovis-test"] = "video-test"
    columns: tuple[str, ...] = SEVEN_COLUMNS
    """Errors of the summary table, in its order; all seven are always in the CSV."""
    quirks: frozenset[Quirk] = frozenset()

    def words(self) -> tuple[str, ...]:
        """The protocol in sentences, to print beneath a table."""
        caps = "the data set's" if self.caps_mm is None else f"{self.caps_mm[0]:g} to {self.caps_mm[1]:g} mm"
        where = "for each sequence" if self.per == "sequence" else "for each frame"
        temporal = {
            "endodav": "TAE and TAS between adjacent frames as EndoDAV defines them",
            "vda": "TAE between adjacent frames as Video Depth Anything defines it",
            None: "none",
        }[self.temporal]
        holes = "left out, and counted as coverage" if Quirk.HOLES_CLIPPED not in self.quirks else "see quirks"
        lines = [
            f"Protocol {self.name}: {self.source}.",
            f"Alignment: {ALIGNMENT_WORDS[self.alignment]}, {where}.",
            f"Averaging: errors over the pixels of a frame; {AVERAGING_WORDS[self.averaging]}; "
            "frames without true depth are left out and counted.",
            f"Caps: {caps}; truth strictly inside, aligned depth clipped to them.",
            f"Resizing: {RESIZE_WORDS[self.resize]}. Crop: {'as published' if self.crop else 'none'}. "
            f"Camera matrix: {'told' if self.intrinsics == 'known' else 'not told'} to systems.",
            f"Pixels without a prediction: {holes}. Temporal: {temporal}.",
        ]
        if self.quirks:
            lines.append("Quirks: " + "; ".join(f"{q.value} ({QUIRK_WORDS[q]})" for q in sorted(self.quirks)) + ".")
        return tuple(lines)

    @property
    def hash(self) -> str:
        """First 12 digits of the SHA-256 of all that numbers depend on; equal hashes, comparable numbers."""
        fields = asdict(self) | {"quirks": sorted(self.quirks)}
        for told in ("name", "source", "columns"):
            del fields[told]
        return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()[:12]


_CHOICES: dict[str, dict[str, Any]] = {
    "alignment": {word: word for word in get_args(AlignmentKind)},
    "per": {"sequence": "sequence", "frame": "frame"},
    "averaging": {word: word for word in get_args(Averaging)},
    "resize": {word: word for word in get_args(Resize)},
    "temporal": {"endodav": "endodav", "vda": "vda", "none": None},
    "crop": {"published": True, "none": False},
    "intrinsics": {"unknown": "unknown", "known": "known"},
}
"""What fields can be changed to, by the word on the command line."""
PROTOCOLS: dict[str, Protocol] = {
    protocol.name: protocol
    for protocol in (
        Protocol(
            name="paper",
            source="the paper's Tables 1 to 3 (median scaling following EndoDAV, mean over scenes)",
            columns=PAPER_COLUMNS,
        ),
        Protocol(
            name="endodav",
            source="EndoDAV's evaluation of whole videos, with its default alignment",
            alignment="scale_shift",
            averaging="frames",
        ),
        Protocol(
            name="endodac",
            source="AF-SfMLearner, EndoDAC and their family: single frames, 551 of SCARED",
            per="frame",
            averaging="frames",
            resize="disparity",
            crop=True,
            temporal=None,
            scared_split="endovis-test",
        ),
        Protocol(
            name="vda",
            source="Video Depth Anything's benchmark of affine-invariant disparity",
            alignment="affine_disparity",
            averaging="frames",
            resize="disparity",
            temporal="vda",
        ),
    )
}


def changed(protocol: Protocol, changes: Iterable[str]) -> Protocol:
    """A protocol with fields replaced, which its name then says.

    Args:
        protocol: To begin with.
        changes: ``alignment``, ``per``, ``averaging``, ``resize``, ``temporal``, ``crop``, ``intrinsics`` or
            ``caps`` (in mm, ``LOW:HIGH``), each as ``field=value``.

    Raises:
        SettingsError: If a field or its value is not known; lists those that are.
    """
    values: dict[str, Any] = {}
    for change in changes:
        field, _, word = change.partition("=")
        if field == "caps":
            values["caps_mm"] = _caps(change, word)
            continue
        choices = _CHOICES.get(field)
        if choices is None:
            raise SettingsError(f"--change {change}: no such field; there are caps, {', '.join(_CHOICES)}")
        if word not in choices:
            raise SettingsError(f"--change {change}: {field} is one of {', '.join(choices)}")
        values[field] = choices[word]
    name = " ".join([protocol.name, *changes]) if values else protocol.name
    return replace(protocol, name=name, **values)


def _caps(change: str, word: str) -> tuple[float, float]:
    try:
        low, high = (float(part) for part in word.split(":"))
    except ValueError as error:
        raise SettingsError(f"--change {change}: caps are two numbers in mm, LOW:HIGH") from error
    if not 0 <= low < high:
        raise SettingsError(f"--change {change}: caps run from low to high, got {low:g} and {high:g}")
    return low, high


def named_protocol(name: str, compat: Iterable[str] = ()) -> Protocol:
    """A protocol by name, with the quirks asked for.

    Args:
        name: One of :data:`PROTOCOLS`.
        compat: Names of quirks, or of public evaluators for all of theirs.

    Raises:
        SettingsError: If a name is not known; lists those that are.
    """
    if name not in PROTOCOLS:
        raise SettingsError(f"no protocol {name!r}; there are {', '.join(PROTOCOLS)}")
    quirks: set[Quirk] = set()
    for word in compat:
        if word not in COMPATIBLE and word not in {quirk.value for quirk in Quirk}:
            known = ", ".join([*COMPATIBLE, *(quirk.value for quirk in Quirk)])
            raise SettingsError(f"--compat {word}: no such evaluator or quirk; there are {known}")
        quirks |= COMPATIBLE[word] if word in COMPATIBLE else {Quirk(word)}
    if Quirk.HOLES_CLIPPED in quirks and PROTOCOLS[name].alignment == "affine_disparity":
        raise SettingsError(f"--compat {Quirk.HOLES_CLIPPED}: {name} fits disparity, which a hole does not have")
    return replace(PROTOCOLS[name], quirks=frozenset(quirks))
