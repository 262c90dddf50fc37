"""Many clips, one after the other; what is done is skipped, what fails is named and the rest goes on."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ValidationError

from bathyscope.engines import DepthOptions
from bathyscope.errors import BathyscopeError
from bathyscope.result import ResultMeta
from bathyscope.result_files import Precision
from bathyscope_client.clips import LocalClip, images_in
from bathyscope_client.outputs import made_of, output_paths, write_outputs
from bathyscope_client.runners import OnProgress, Runner

MARKER_SUFFIX = "_done.json"


class BatchSettings(BaseModel, frozen=True, extra="forbid"):
    """What decides the content of the output files."""

    options: DepthOptions = DepthOptions()
    precision: Precision = "float32"
    most_points: int = 500_000


class Done(BaseModel, frozen=True, extra="forbid"):
    """Says what the files of a clip were made of; written after the last of them."""

    source: str
    bytes: int
    changed_ns: int
    model: str
    settings: BatchSettings
    meta: ResultMeta

    def same_as(self, other: Done) -> bool:
        """Whether the other would give the same files; the meta data does not count."""
        return self.model_copy(update={"meta": other.meta}) == other


class ClipReport(BaseModel, frozen=True):
    """What became of one clip."""

    name: str
    source: str
    status: Literal["done", "skipped", "failed"]
    outputs: dict[str, str] = {}
    error: str | None = None
    status_code: int | None = None
    request_id: str | None = None
    meta: ResultMeta | None = None


def run_batch(
    clips: Iterable[LocalClip],
    out: Path,
    runner: Runner,
    settings: BatchSettings,
    *,
    progress: Callable[[LocalClip], OnProgress],
    again: bool = False,
) -> Iterator[ClipReport]:
    """Make the files of each clip.

    Args:
        clips: The clips.
        out: Folder for the files; made if need be.
        runner: Makes the results.
        settings: What is asked for.
        progress: Gives the function that hears about one clip's progress.
        again: Make files again that are already there.

    Yields:
        A report after each clip; a failed clip does not stop the others.
    """
    out.mkdir(parents=True, exist_ok=True)
    batch = _Batch(out, runner, settings, again)
    for clip in clips:
        try:
            yield batch.one(clip, progress(clip))
        except (BathyscopeError, OSError) as error:
            yield ClipReport(
                name=clip.name,
                source=str(clip.path),
                status="failed",
                error=str(error),
                status_code=getattr(error, "status", None),
                request_id=getattr(error, "request_id", None),
            )


@dataclass(frozen=True, slots=True)
class _Batch:
    out: Path
    runner: Runner
    settings: BatchSettings
    again: bool

    def one(self, clip: LocalClip, progress: OnProgress) -> ClipReport:
        """Make the files of one clip unless they are there already."""
        size, changed_ns = _fingerprint(clip.path)
        wanted = Done(
            source=clip.path.name,
            bytes=size,
            changed_ns=changed_ns,
            model=self.runner.model,
            settings=self.settings,
            meta=ResultMeta(),
        )
        paths = output_paths(self.out, clip.name)
        marker = self.out / f"{clip.name}{MARKER_SUFFIX}"
        found = _read_marker(marker)
        same = found is not None and found.same_as(wanted)
        if found and same and all(paths[kind].is_file() for kind in made_of(found.meta)) and not self.again:
            return _report(clip, "skipped", paths, found.meta)
        marker.unlink(missing_ok=True)
        meta = self._make(clip, paths, progress)
        _write_marker(marker, wanted.model_copy(update={"meta": meta}))
        return _report(clip, "done", paths, meta)

    def _make(self, clip: LocalClip, paths: dict[str, Path], progress: OnProgress) -> ResultMeta:
        """Make the files in a folder beside, then move them to their places."""
        beside = self.out / f".{clip.name}.part"
        shutil.rmtree(beside, ignore_errors=True)
        beside.mkdir()
        try:
            drafts = output_paths(beside, clip.name)
            self.runner.run(clip.path, drafts["depth"], self.settings.options, self.settings.precision, progress)
            progress("writing", 0, None)
            meta = write_outputs(
                clip.path, drafts, self.settings.most_points, lambda done, total: progress("writing", done, total)
            )
            made = made_of(meta)
            for kind, path in paths.items():
                if kind in made:
                    drafts[kind].replace(path)
                else:
                    path.unlink(missing_ok=True)  # of a model that had cameras
        finally:
            shutil.rmtree(beside, ignore_errors=True)
        return meta


def _fingerprint(path: Path) -> tuple[int, int]:
    """Bytes and latest change of a file, or of the images of a folder."""
    stats = [item.stat() for item in (images_in(path) if path.is_dir() else [path])]
    return sum(stat.st_size for stat in stats), max((stat.st_mtime_ns for stat in stats), default=0)


def _read_marker(path: Path) -> Done | None:
    """The marker, or nothing where there is none that this version wrote: then the clip is made again."""
    try:
        return Done.model_validate_json(path.read_bytes())
    except (FileNotFoundError, ValidationError):
        return None


def _write_marker(path: Path, done: Done) -> None:
    beside = path.with_name(path.name + ".part")
    beside.write_text(done.model_dump_json(indent=1) + "\n")
    beside.replace(path)


def _report(
    clip: LocalClip, status: Literal["done", "skipped"], paths: dict[str, Path], meta: ResultMeta
) -> ClipReport:
    outputs = {kind: str(paths[kind]) for kind in made_of(meta)}
    return ClipReport(name=clip.name, source=str(clip.path), status=status, outputs=outputs, meta=meta)
