"""A range of a data set folder's frames as a folder of its own, to train on one part and to measure on another."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bathyscope.errors import DatasetError
from bathyscope_train.evaluation.images import image_files

_TRUTH = ("depth", "poses.txt", "sparse.npz")
_EVERYWHERE = ("mask.png", "intrinsics.json")
_OF_OBSERVATIONS = "obs_"


def cut_folder(folder: Path, out: Path, *, start: int = 0, stop: int | None = None, frames_only: bool = False) -> int:
    """Copy frames ``start`` to ``stop`` (not included) with what belongs to them; returns how many.

    Frames keep their names. Lists of one entry a frame (``source_frame_indices``) in ``intrinsics.json`` are cut too.

    Args:
        folder: In Bathyscope's layout (docs/conventions.md).
        out: New folder.
        start: First frame, counted from 0 in the order of their names.
        stop: Frame after the last; to the end unless given.
        frames_only: Leave out everything that training without truth must not see: depth, points and poses.

    Raises:
        DatasetError: If the folder has no such frames, or ``out`` exists.
    """
    files = image_files(folder / "frames")
    chosen = files[start:stop]
    if not chosen:
        end = "the end" if stop is None else stop
        raise DatasetError(
            f"{folder}: has {len(files)} frames in frames/, none from {start} to {end}; give a range inside it"
        )
    if out.exists():
        raise DatasetError(f"{out}: exists; name a folder that does not, or remove it")
    partial = out.with_name(f".{out.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    _copy(chosen, partial / "frames")
    for name in _EVERYWHERE:
        if (folder / name).is_file():
            shutil.copyfile(folder / name, partial / name)
    _cut_lists(partial / "intrinsics.json", len(files), start, stop)
    if not frames_only:
        _cut_truth(folder, partial, chosen, start)
    partial.rename(out)
    return len(chosen)


def _cut_truth(folder: Path, out: Path, chosen: Sequence[Path], start: int) -> None:
    depth, poses, sparse = (folder / name for name in _TRUTH)
    stems = {path.stem for path in chosen}
    if depth.is_dir():
        _copy([path for path in image_files(depth) if path.stem in stems], out / depth.name)
    if poses.is_file():
        names = {path.name for path in chosen}
        lines = poses.read_text(encoding="utf-8").splitlines()
        kept = [line for line in lines if not line.strip() or line.startswith("#") or line.split()[0] in names]
        (out / poses.name).write_text("\n".join(kept) + "\n", encoding="utf-8")
    if sparse.is_file():
        with np.load(sparse) as archive:
            arrays = {name: archive[name] for name in archive.files}
        seen = arrays["obs_frame"] - start
        inside = (seen >= 0) & (seen < len(chosen))
        cut = {name: values[inside] if name.startswith(_OF_OBSERVATIONS) else values for name, values in arrays.items()}
        np.savez_compressed(out / sparse.name, **{**cut, "obs_frame": seen[inside].astype(seen.dtype)})


def _cut_lists(path: Path, frames: int, start: int, stop: int | None) -> None:
    if not path.is_file():
        return
    stated = json.loads(path.read_text(encoding="utf-8"))
    cut = {
        name: value[start:stop] if isinstance(value, list) and len(value) == frames else value
        for name, value in stated.items()
    }
    path.write_text(json.dumps(cut, indent=1) + "\n", encoding="utf-8")


def _copy(files: Sequence[Path], out: Path) -> None:
    out.mkdir(parents=True)
    for path in files:
        shutil.copyfile(path, out / path.name)
