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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast, get_args

from bathyscope.bundle import MANIFEST, Bundle, shipped_bundle
from bathyscope.errors import CheckpointError, SettingsError
from bathyscope.result import DepthKind
from bathyscope_train.systems.baselines import BASELINES
from bathyscope_train.systems.engine_system import EngineSystem
from bathyscope_train.systems.kinds import KINDS, Kind, bare
from bathyscope_train.systems.options import refuse_options
from bathyscope_train.systems.system import System, SystemOptions

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
    kind = _kind(name.what)
    if kind is not None:
        return Unavailable(name.label or kind.name, f"weights not available: {kind.weights}; give {kind.name}=FILE")
    raise SettingsError(f"{name.what}: no such file or folder, and none of the names {', '.join(known())}")


def _open_path(path: Path, name: SystemName, options: SystemOptions) -> System:
    if _is_bundle(path):
        return EngineSystem.from_bundle(Bundle.open(path), options, label=name.label)
    kind = _recognise(path, name)
    if kind is not None:
        return kind.open(path, kind, options)
    from bathyscope_train.systems.networks import open_own

    return open_own(path, name.label or path.stem, options)


def _is_bundle(path: Path) -> bool:
    if path.is_dir():
        return (path / MANIFEST).is_file()
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return MANIFEST in archive.namelist()


def _recognise(path: Path, name: SystemName) -> Kind | None:
    """The kind of published weights at ``path``; ``None`` for a checkpoint that says its own network."""
    wanted = None if name.label is None else _kind(name.label)
    if path.is_dir():
        found = [kind for kind in KINDS if kind.member is not None and (path / kind.member).is_file()]
        wanted_files = sorted({kind.member for kind in KINDS if kind.member is not None})
        if not found:
            raise CheckpointError(f"{path}: neither a bundle ({MANIFEST}) nor weights ({', '.join(wanted_files)})")
        file = path / cast(str, found[0].member)
    else:
        found, file = list(KINDS), path
    from bathyscope_train.model.checkpoints import names_its_network
    from bathyscope_train.model.weight_files import open_weights

    weights = open_weights(file)
    if names_its_network(weights):
        if wanted is not None:
            raise CheckpointError(f"{path}: says itself which network it holds; it is no {wanted.name}")
        return None
    shapes = {bare(key): shape for key, shape in weights.shapes.items()}
    fitting = [kind for kind in found if kind.recognises(shapes)]
    if wanted is not None and wanted not in fitting:
        what = f"those of {fitting[0].name}" if fitting else f"{len(shapes)} unknown ones, like {next(iter(shapes))}"
        raise CheckpointError(f"{path}: holds no {wanted.name}: its tensors are {what}")
    if not fitting:
        raise CheckpointError(
            f"{path}: its {len(shapes)} tensors (like {next(iter(shapes))}) are those of no network known here: "
            f"{', '.join(kind.name for kind in KINDS)}, or a checkpoint that `bathyscope train` wrote"
        )
    return wanted or _by_file_name(file, fitting)


def _by_file_name(path: Path, kinds: list[Kind]) -> Kind:
    """Metric and relative weights have the same keys; the published files say it in their names."""
    metric = [kind for kind in kinds if kind.name.endswith("-metric")]
    return metric[0] if metric and "metric" in path.stem else kinds[0]


def _kind(name: str) -> Kind | None:
    return next((kind for kind in KINDS if kind.name == name), None)
