"""The file of a run's numbers, a JSON object a line, each with the step it is about."""

import json
from pathlib import Path

METRICS_FILE = "metrics.jsonl"


def drop_after(path: Path, step: int) -> None:
    """Remove lines about steps after ``step``, and a last line that was cut short, from ``metrics.jsonl``."""
    if not path.is_file():
        return
    kept = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            if json.loads(line)["step"] <= step:
                kept.append(line)
        except (ValueError, KeyError):
            continue
    beside = path.with_name(f".{path.name}")
    beside.write_text("".join(f"{line}\n" for line in kept), encoding="utf-8")
    beside.replace(path)
