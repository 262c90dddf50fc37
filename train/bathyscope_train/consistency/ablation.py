"""Which term brings what: train on a target domain without its truth, then measure on it and on the source.

    python -m bathyscope_train.consistency.ablation configs/ablation.yaml init=CHECKPOINT data=FOLDER

Every run has a folder of its own and is done once: an experiment that was interrupted goes on where it stopped. A run
that fails is told in the table and does not stop the others.
"""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from bathyscope.errors import BathyscopeError, CheckpointError, TrainingError
from bathyscope_train.consistency.ablation_settings import AblationSettings, load_ablation_settings, run_name
from bathyscope_train.consistency.ablation_table import Outcome, tables
from bathyscope_train.consistency.plan import make_plan
from bathyscope_train.consistency.scores import ClipScores, Scores, score_clip, score_network
from bathyscope_train.consistency.start import load_initial
from bathyscope_train.consistency.trainer import optimise
from bathyscope_train.data.windows import TruthClip
from bathyscope_train.metrics_file import METRICS_FILE
from bathyscope_train.model.checkpoints import load_network
from bathyscope_train.model.network import Network
from bathyscope_train.pretrain import held_out_clips
from bathyscope_train.validation import window_index

BASELINE, CONSTANT = "baseline", "constant depth"
SCORES_FILE, TABLE_FILE = "scores.json", "table.md"

_log = logging.getLogger(__name__)


def run_ablation(settings: AblationSettings) -> Path:
    """Do what is not done yet and write the tables; returns their path.

    Raises:
        SettingsError: If a variant cannot be trained.
        CheckpointError: If the initial checkpoint cannot be used.
        DatasetError: If there is nothing to train on or to measure on.
    """
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    folders = {"target": settings.target, **({"source": settings.source} if settings.source else {})}
    held_out = {name: held_out_clips(folder, settings.clips) for name, folder in folders.items()}
    first = settings.run_settings(next(iter(settings.variants)), settings.seeds[0])
    frames = first.window.frames
    outcomes = [constant_outcome(held_out, frames)]
    folder = settings.out / BASELINE
    if not (folder / SCORES_FILE).is_file():
        _write_scores(folder, _scored(load_initial(first.init, first.preset).eval(), held_out, frames))
    outcomes.append(read_outcome(folder, BASELINE, None))
    for seed in settings.seeds:
        for variant in settings.variants:
            folder = settings.out / run_name(variant, seed)
            if not (folder / SCORES_FILE).is_file():
                _run(settings, variant, seed, held_out)
            outcomes.append(read_outcome(folder, variant, seed))
    path = settings.out / TABLE_FILE
    beside = path.with_name(f".{path.name}")
    beside.write_text(tables(outcomes, baseline=BASELINE), encoding="utf-8")
    beside.replace(path)
    return path


def ablation_plan(settings: AblationSettings) -> str:
    """What would be done: which runs are left, and the plan of the first."""
    names = [run_name(variant, seed) for seed in settings.seeds for variant in settings.variants]
    left = [name for name in names if not (settings.out / name / SCORES_FILE).is_file()]
    plan = make_plan(settings.run_settings(next(iter(settings.variants)), settings.seeds[0]))
    return f"{len(left)} of {len(names)} runs are left: {', '.join(left)}\n\nthe first of all\n{plan}"


def _run(settings: AblationSettings, variant: str, seed: int, held_out: dict[str, list[TruthClip]]) -> None:
    """Train one variant with one seed, and measure it; a failure is an outcome too."""
    chosen = settings.run_settings(variant, seed)
    _log.info("%s, seed %d: %d steps in %s", variant, seed, chosen.steps, chosen.out)
    try:
        path = optimise(chosen)
    except TrainingError as error:
        _log.error("%s, seed %d: %s", variant, seed, error)
        _write_scores(chosen.out, {"failed": str(error)})
        return
    _write_scores(chosen.out, _scored(load_network(path)[0], held_out, chosen.window.frames))


def _scored(network: Network, held_out: dict[str, list[TruthClip]], frames: int) -> dict[str, Any]:
    return {
        name: [asdict(each) for each in score_network(network, clips, frames=frames)]
        for name, clips in held_out.items()
    }


def constant_outcome(held_out: dict[str, list[TruthClip]], frames: int) -> Outcome:
    """What depth that is the same everywhere scores: the floor that any network has to beat."""
    scores = {}
    for name, clips in held_out.items():
        truths = [clip.depth[window_index(len(clip.depth), frames)].numpy() for clip in clips]
        scores[name] = [score_clip(clip.name, np.ones_like(t), t) for clip, t in zip(clips, truths, strict=True)]
    return Outcome(CONSTANT, None, scores)


def _write_scores(folder: Path, scores: dict[str, Any]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    beside = folder / f".{SCORES_FILE}"
    beside.write_text(json.dumps(scores, indent=1), encoding="utf-8")
    beside.replace(folder / SCORES_FILE)


def read_outcome(folder: Path, variant: str, seed: int | None) -> Outcome:
    """What a run left behind.

    Raises:
        CheckpointError: If its scores cannot be read.
    """
    path = folder / SCORES_FILE
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if "failed" in record:
            return Outcome(variant, seed, {}, failed=str(record["failed"]), course=_course(folder))
        scores = {
            name: [ClipScores(each["name"], Scores(**each["full"]), Scores(**each["central"])) for each in clips]
            for name, clips in record.items()
        }
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise CheckpointError(f"{path}: cannot be read ({error}); remove it to measure again") from error
    return Outcome(variant, seed, scores, course=_course(folder))


def _course(folder: Path) -> tuple[float, ...]:
    """AbsRel of rendered depth at every validation of a run, the start first."""
    path = folder / METRICS_FILE
    if not path.is_file():
        return ()
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return tuple(float(line["rendered_abs_rel"]) for line in lines if "rendered_abs_rel" in line)


def main(arguments: Sequence[str]) -> int:
    """The command: a settings file and overrides."""
    if not arguments:
        sys.stderr.write("usage: python -m bathyscope_train.consistency.ablation SETTINGS [name=value ...]\n")
        return 2
    try:
        path = run_ablation(load_ablation_settings(Path(arguments[0]), arguments[1:]))
    except BathyscopeError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    sys.stdout.write(path.read_text(encoding="utf-8"))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
