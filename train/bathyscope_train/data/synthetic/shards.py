"""Clips on disk: one uncompressed npz a clip, quick to read, written once however often it is asked for."""

import os
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from bathyscope.errors import DatasetError, SettingsError
from bathyscope_train.data.synthetic.clip import SyntheticClip, render_clip
from bathyscope_train.data.synthetic.domain import Domain
from bathyscope_train.data.synthetic.lens import PINHOLE, Distortion
from bathyscope_train.data.synthetic.swell import Swell

_FORMAT = 1


def write_clip(path: Path, clip: SyntheticClip) -> None:
    """Write a clip beside ``path`` and rename it into place. Depth is kept as float16 millimetres (0.05 %).

    The arrays are named as the clip's fields; the swell's begin with ``swell_`` and are there only where it is.
    """
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    with beside.open("wb") as file:
        np.savez(
            file,
            format=np.int64(_FORMAT),
            frames=clip.frames,
            depth=clip.depth.astype(np.float16),
            world_from_camera=clip.world_from_camera,
            intrinsics=clip.intrinsics,
            distortion=np.array(clip.distortion, np.float64),
            mover=clip.mover,
            world_from_mover=clip.world_from_mover,
            **_swell_arrays(clip.swell),
            name=np.array(clip.name),
            seed=np.int64(clip.seed),
            domain=np.array(clip.domain),
        )
    beside.replace(path)


def read_clip(path: Path) -> SyntheticClip:
    """Read a clip that ``write_clip`` wrote.

    Raises:
        DatasetError: If the file is missing, damaged or of a format this build does not read.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            found = int(file["format"])
            if found != _FORMAT:
                raise DatasetError(f"{path}: clip format {found}, this build reads {_FORMAT}; render the clips again")
            depth = file["depth"].astype(np.float32)
            count = len(depth)
            moves = "mover" in file
            return SyntheticClip(
                frames=file["frames"],
                depth=depth,
                valid=depth > 0,
                world_from_camera=file["world_from_camera"],
                intrinsics=file["intrinsics"],
                distortion=Distortion(*map(float, file["distortion"])) if "distortion" in file else PINHOLE,
                mover=file["mover"] if moves else np.zeros(depth.shape, np.uint8),
                world_from_mover=file["world_from_mover"] if moves else np.zeros((count, 0, 4, 4)),
                swell=_read_swell(file),
                name=str(file["name"]),
                seed=int(file["seed"]),
                domain=str(file["domain"]),
            )
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise DatasetError(f"{path}: not a rendered clip: {error}") from error


def _swell_arrays(swell: Swell | None) -> dict[str, Any]:
    """The swell's numbers under names of their own; nothing where the tissue stands still."""
    if swell is None:
        return {}
    return {f"swell_{name}": np.asarray(value, np.float64) for name, value in swell._asdict().items()}


def _read_swell(file: Mapping[str, Any]) -> Swell | None:
    if "swell_kind" not in file:
        return None
    numbers = {name: file[f"swell_{name}"] for name in Swell._fields}
    return Swell(
        kind=int(numbers["kind"]),
        waves=numbers["waves"],
        centre=numbers["centre"],
        first=float(numbers["first"]),
        step=float(numbers["step"]),
        scene_from_world=numbers["scene_from_world"],
    )


def clip_paths(root: Path) -> list[Path]:
    """The clips of a folder, in order of their seeds.

    Raises:
        DatasetError: If there are none.
    """
    paths = sorted(root.glob("[0-9]*.npz"))
    if not paths:
        raise DatasetError(f"{root}: no rendered clips; write some with python -m bathyscope_train.data.synthetic")
    return paths


def write_clips(
    root: Path,
    domain: Domain,
    seeds: Iterable[int],
    *,
    frames: int = 16,
    size: tuple[int, int] = (112, 140),
    processes: int = 2,
) -> Iterator[Path]:
    """Render the clips that ``root`` does not hold yet; yields every path as its clip is there.

    The folder keeps the domain it was rendered from in ``domain.json``.

    Args:
        root: Folder, made if missing.
        domain: What to render.
        seeds: One clip a seed.
        frames: Length of each.
        size: Height and width.
        processes: Renderers at the same time; 1 renders in this process.

    Raises:
        SettingsError: If the folder holds clips of other settings.
    """
    root.mkdir(parents=True, exist_ok=True)
    _stamp(root, domain, frames, size)
    paths = {seed: root / f"{seed:07d}.npz" for seed in seeds}
    missing = [seed for seed, path in paths.items() if not path.exists()]
    yield from (path for seed, path in paths.items() if seed not in set(missing))
    job = partial(_render_to, root=root, domain=domain, frames=frames, size=size)
    if processes <= 1:
        yield from map(job, missing)
        return
    # Spawned, not forked: the parent may hold torch's threads.
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        yield from pool.map(job, missing)


def _render_to(seed: int, *, root: Path, domain: Domain, frames: int, size: tuple[int, int]) -> Path:
    path = root / f"{seed:07d}.npz"
    write_clip(path, render_clip(seed, domain, frames=frames, size=size))
    return path


def _stamp(root: Path, domain: Domain, frames: int, size: tuple[int, int]) -> None:
    """Write down what the folder holds, or refuse to mix two things in it."""
    text = f'{{"frames": {frames}, "size": [{size[0]}, {size[1]}], "domain": {domain.model_dump_json()}}}\n'
    stamp = root / "domain.json"
    if not stamp.exists():
        stamp.write_text(text, encoding="utf-8")
    elif stamp.read_text(encoding="utf-8") != text:
        raise SettingsError(f"{stamp}: the folder holds clips of other settings; choose another folder or empty it")
