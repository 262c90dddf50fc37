"""The model bundle: a folder, or one .zip, with a manifest, ONNX graphs and their weights.

A bundle is untrusted input. Opening one checks, before anything is handed to a runtime: the manifest's shape, that
every name stays inside the folder and is no link, sizes, the SHA-256 of every file, that nothing unnamed lies
beside them, and that the graphs refer to no weights but the bundle's own (:mod:`bathyscope.external_data`).
"""

from __future__ import annotations

import hashlib
import re
import shutil
import tempfile
import weakref
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, Field, PositiveInt, ValidationError, field_validator, model_validator

from bathyscope.errors import BundleError
from bathyscope.external_data import external_locations
from bathyscope.model_spec import Kind, ModelSpec
from bathyscope.result import BundleId
from bathyscope.zip_errors import ZIP_ERRORS

BUNDLE_FORMAT = 2
"""The newest bundle format that this build reads."""
MANIFEST = "bundle.json"
MAX_MANIFEST_BYTES = 1 << 20
MAX_BUNDLE_BYTES = 16 << 30
MAX_GRAPH_BYTES = 1 << 29

_PLAIN_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,127}")
Role = Literal["backbone", "heads", "cameras"]
ROLES: dict[Kind, tuple[Role, ...]] = {"scene": ("backbone", "heads", "cameras"), "video": ("backbone", "heads")}
"""Graphs that a bundle of each kind holds, in the order in which they run."""


class _Strict(BaseModel, frozen=True, extra="forbid"):
    """Frozen, and unknown fields are refused."""


class FileEntry(_Strict):
    """Size and hash of one file."""

    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    bytes: int = Field(ge=0)


class GraphSpec(_Strict):
    """One ONNX graph; its inputs and outputs by name, in order.

    ``backbone`` takes ``images`` (t, 3, h, w) in [0, 1] and returns feature maps; ``heads`` takes ``images`` and
    some of these, frame by frame, and returns ``depth`` and ``confidence`` (t, h, w) and ``gaussians``
    (t, c, h, w), raw, where the network has any; ``cameras`` takes what its inputs name, among them maybe ``focal``
    (1,) in pixels (0: not known), and returns ``pose_encoding`` (t, 9) and, where it corrects depth by the motion
    between the frames, ``refined_depth`` (t, h, w). A video network has no ``cameras``, and its ``heads`` return
    ``values`` (t, h, w).
    """

    file: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


class BundleManifest(ModelSpec):
    """``bundle.json``."""

    format: PositiveInt = BUNDLE_FORMAT
    graphs: dict[Role, GraphSpec]
    weights: str
    files: dict[str, FileEntry]
    research_only: bool
    training: dict[str, Any] = Field(default_factory=dict, description="Data, settings and seeds of the weights.")
    parity: list[dict[str, Any]] = Field(default_factory=list, description="Differences from torch, by clip shape.")
    accuracy: dict[str, Any] = Field(default_factory=dict, description="Measured accuracy, with protocol.")

    @field_validator("format")
    @classmethod
    def _readable(cls, value: int) -> int:
        if value > BUNDLE_FORMAT:
            raise ValueError(
                f"bundle format {value} is newer than this build reads ({BUNDLE_FORMAT}); upgrade bathyscope"
            )
        return value

    @model_validator(mode="after")
    def _names_are_plain_and_listed(self) -> BundleManifest:
        for name in self.files:
            if not _PLAIN_NAME.fullmatch(name):
                raise ValueError(f"file name {name!r} is not a plain name inside the bundle")
        missing = {self.weights, *(graph.file for graph in self.graphs.values())} - set(self.files)
        if missing:
            raise ValueError(f"{sorted(missing)} are used but have no entry in 'files'")
        roles = set(ROLES[self.kind]) - set(self.graphs)
        if roles:
            raise ValueError(f"graphs {sorted(roles)} are missing")
        return self


@dataclass(frozen=True)
class Bundle:
    """A checked bundle on disk."""

    folder: Path
    manifest: BundleManifest
    digest: str

    @classmethod
    def open(cls, path: Path | str) -> Bundle:
        """Check a bundle folder or .zip and read its manifest.

        A .zip is unpacked into a temporary folder that lives as long as the bundle.

        Raises:
            BundleError: If anything about it is missing, damaged, unsafe or too new; names the file.
        """
        path = Path(path)
        if path.is_dir():
            return cls._open_folder(path, label=str(path))
        if not path.is_file():
            raise BundleError(f"{path}: no such bundle; give a folder with {MANIFEST}, or a .zip of one")
        folder = Path(tempfile.mkdtemp(prefix="bathyscope-bundle-"))
        try:
            _unpack(path, folder)
            bundle = cls._open_folder(folder, label=str(path))
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        weakref.finalize(bundle, shutil.rmtree, folder, ignore_errors=True)
        return bundle

    @classmethod
    def _open_folder(cls, folder: Path, label: str) -> Bundle:
        text = _read_manifest(folder, label)
        try:
            manifest = BundleManifest.model_validate_json(text)
        except ValidationError as error:
            problems = "; ".join(f"{'.'.join(map(str, e['loc'])) or 'bundle'}: {e['msg']}" for e in error.errors())
            raise BundleError(f"{label}: {MANIFEST} cannot be used: {problems}") from error
        _check_files(folder, manifest, label)
        for graph in manifest.graphs.values():
            _check_external_data(folder / graph.file, manifest.weights, label)
        return cls(folder, manifest, hashlib.sha256(text).hexdigest())

    @property
    def id(self) -> BundleId:
        """Name, version and digest, as results carry them."""
        return BundleId(name=self.manifest.name, version=self.manifest.version, digest=self.digest)

    def graph(self, role: Role) -> Path:
        """Path of a graph's ONNX file."""
        return self.folder / self.manifest.graphs[role].file


def shipped_bundle() -> Path:
    """Folder of the bundle that ships with the package.

    Raises:
        BundleError: If this installation has none.
    """
    folder = Path(__file__).parent / "models" / "tiny"
    if not (folder / MANIFEST).is_file():
        raise BundleError(f"this installation has no shipped bundle ({folder}); give one with --bundle")
    return folder


def hash_file(path: Path) -> FileEntry:
    """Size and SHA-256 of a file."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return FileEntry(sha256=digest.hexdigest(), bytes=path.stat().st_size)


def write_manifest(folder: Path, manifest: BundleManifest) -> None:
    """Write ``bundle.json`` beside and rename it into place."""
    beside = folder / (MANIFEST + ".part")
    beside.write_text(manifest.model_dump_json(indent=1) + "\n")
    beside.replace(folder / MANIFEST)


def _read_manifest(folder: Path, label: str) -> bytes:
    path = folder / MANIFEST
    if path.is_symlink() or not path.is_file():
        raise BundleError(f"{label}: no {MANIFEST} in it; a bundle is a folder that `bathyscope export` wrote")
    if path.stat().st_size > MAX_MANIFEST_BYTES:
        raise BundleError(f"{label}: {MANIFEST} has {path.stat().st_size} bytes; at most {MAX_MANIFEST_BYTES} are read")
    return path.read_bytes()


def _check_files(folder: Path, manifest: BundleManifest, label: str) -> None:
    total = sum(entry.bytes for entry in manifest.files.values())
    if total > MAX_BUNDLE_BYTES:
        raise BundleError(f"{label}: {total} bytes in all; at most {MAX_BUNDLE_BYTES} are read")
    strangers = {entry.name for entry in folder.iterdir()} - set(manifest.files) - {MANIFEST}
    if strangers:
        raise BundleError(f"{label}: {sorted(strangers)} lie in the bundle but not in {MANIFEST}; remove them")
    for name, wanted in manifest.files.items():
        path = folder / name
        if path.is_symlink():
            raise BundleError(f"{label}: {name} is a link; a bundle holds plain files only")
        if not path.is_file():
            raise BundleError(f"{label}: {name} is missing; export or copy the bundle again")
        if path.stat().st_size != wanted.bytes:
            raise BundleError(f"{label}: {name} has {path.stat().st_size} bytes, {MANIFEST} says {wanted.bytes}")
        if hash_file(path) != wanted:
            raise BundleError(f"{label}: {name} was changed: its SHA-256 is not the one in {MANIFEST}")


def _check_external_data(path: Path, weights: str, label: str) -> None:
    if path.stat().st_size > MAX_GRAPH_BYTES:
        raise BundleError(f"{label}: graph {path.name} has {path.stat().st_size} bytes; at most {MAX_GRAPH_BYTES}")
    foreign = external_locations(path) - {weights}
    if foreign:
        raise BundleError(f"{label}: {path.name} reads weights from {sorted(foreign)}; only {weights!r} is allowed")


def _unpack(path: Path, folder: Path) -> None:
    """Unpack a bundle .zip: plain names only, one level deep, no more bytes than it declares."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            if sum(member.file_size for member in members) > MAX_BUNDLE_BYTES:
                raise BundleError(f"{path}: unpacks to more than {MAX_BUNDLE_BYTES} bytes")
            for member in members:
                if not _PLAIN_NAME.fullmatch(member.filename):
                    raise BundleError(f"{path}: member {member.filename!r} is not a plain file name")
                with archive.open(member) as source, (folder / member.filename).open("xb") as target:
                    shutil.copyfileobj(source, target, 1 << 20)
    except ZIP_ERRORS as error:
        raise BundleError(f"{path}: neither a bundle folder nor a readable .zip of one ({error})") from error
