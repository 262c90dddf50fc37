"""From what the user names to a system: a bundle, a checkpoint, a baseline, or weights that are not at hand.

::

    constant, brightness          guesses that need no network
    shipped                       the bundle inside the package
    FOLDER or FILE.zip            a bundle
    FILE.safetensors, FILE.pth    weights, recognised by their keys: ours, or a published network of ``KINDS``
    FOLDER                        published weights in several files
    vda-s, anysplat, ...          a published network without its weights: ``Unavailable``

Before any of these ``NAME=`` gives the name in tables; if it is the name of a kind, the file must be of that kind.
After them ``@rendered``, ``@accumulated`` or ``@head`` picks the depth of a system that renders its scene.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast, get_args

from bathyscope.bundle import MANIFEST, Bundle, shipped_bundle
from bathyscope.camera import F64
from bathyscope.clip import FrameSequence
from bathyscope.errors import SettingsError
from bathyscope.result import DepthKind
from bathyscope_train.systems.baselines import BASELINES
from bathyscope_train.systems.engine_system import EngineSystem
from bathyscope_train.systems.kinds import KINDS
from bathyscope_train.systems.options import refuse_options
from bathyscope_train.systems.recognition import kind_called, recognise
from bathyscope_train.systems.system import FrameEstimate, System, SystemInfo, SystemOptions

_LABEL = re.compile(r"([A-Za-z0-9][A-Za-z0-9_.+-]*)=(.+)", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Unavailable:
    """A system that was asked for by name and whose weights are not at hand: a row without numbers, not an error."""

    name: str
    reason: str
    """``weights not available``, and where they are to be had."""


@dataclass(frozen=True, slots=True)
class SystemName:
    """What the user wrote, taken apart."""

    label: str | None
    """Name in tables, if given."""
    what: str
    """Path, or name of a baseline or kind."""
    depth: DepthKind | None

    @classmethod
    def parse(cls, text: str) -> SystemName:
        """``[LABEL=]WHAT[@DEPTH]``; an ``@`` that no kind of depth follows belongs to the path.

        Raises:
            SettingsError: If nothing is named.
        """
        label, what = None, text
        match = _LABEL.fullmatch(text)
        if match is not None and not Path(text).exists():
            label, what = match.group(1), match.group(2)
        start, _, end = what.rpartition("@")
        depth = cast(DepthKind, end) if start and end in get_args(DepthKind) else None
        what = start if depth is not None else what
        if not what:
            raise SettingsError(f"{text!r} names no system; give a bundle, a checkpoint or one of {', '.join(known())}")
        return cls(label, what, depth)


@dataclass(frozen=True, slots=True)
class Labelled:
    """A system under the name that the user gave it."""

    label: str
    system: System

    @property
    def info(self) -> SystemInfo:
        """What the system says, under the other name."""
        return _renamed(self.system.info, self.label)

    def estimate(self, frames: FrameSequence, intrinsics: F64 | None = None) -> Iterator[FrameEstimate]:
        """See :class:`~bathyscope_train.systems.system.System`."""
        return self.system.estimate(frames, intrinsics)


def _labelled(system: System, label: str) -> System:
    if isinstance(system, EngineSystem):
        return replace(system, info=_renamed(system.info, label))
    return Labelled(label, system)


def _renamed(info: SystemInfo, label: str) -> SystemInfo:
    return info.model_copy(update={"name": label, "details": {**info.details, "network": info.name}})


def known() -> tuple[str, ...]:
    """Every name that needs no path."""
    return (*BASELINES, "shipped", *(kind.name for kind in KINDS))


def open_system(text: str, options: SystemOptions | None = None) -> System | Unavailable:
    """The system that ``text`` names; see the module's description for the forms.

    Args:
        text: What the user wrote.
        options: How it is to be run; ``@DEPTH`` in ``text`` goes before ``options.depth``.

    Raises:
        SettingsError: If nothing is known of this name, or an option does not apply to the system.
        CheckpointError: If weights cannot be read, are of no known kind, or not of the kind that was named.
        BundleError: If a bundle cannot be used.
    """
    name = SystemName.parse(text)
    options = options or SystemOptions()
    if name.depth is not None:
        options = options.model_copy(update={"depth": name.depth})
    path = Path(name.what)
    if path.exists():
        return _open_path(path, name, options)
    if name.what in BASELINES:
        refuse_options(name.what, options, takes=())
        return replace(BASELINES[name.what], name=name.label or name.what)
    if name.what == "shipped":
        return EngineSystem.from_bundle(Bundle.open(shipped_bundle()), options, label=name.label)
    kind = kind_called(name.what)
    if kind is not None:
        return Unavailable(name.label or kind.name, f"weights not available: {kind.weights}; give {kind.name}=FILE")
    raise SettingsError(f"{name.what}: no such file or folder, and none of the names {', '.join(known())}")


def _open_path(path: Path, name: SystemName, options: SystemOptions) -> System:
    if _is_bundle(path):
        return EngineSystem.from_bundle(Bundle.open(path), options, label=name.label)
    kind = recognise(path, kind_called(name.label))
    if kind is not None:
        system = kind.open(path, kind, options)
        return system if name.label in (None, kind.name) else _labelled(system, name.label)
    from bathyscope_train.systems.networks import open_own

    return open_own(path, name.label or path.stem, options)


def _is_bundle(path: Path) -> bool:
    if path.is_dir():
        return (path / MANIFEST).is_file()
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return MANIFEST in archive.namelist()
