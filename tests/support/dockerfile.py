"""Just enough of a Dockerfile reader for this repository's own."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Instruction:
    name: str
    value: str


def read_stages(path: Path) -> list[list[Instruction]]:
    """Instructions by stage; lines continued with a backslash are joined, comments dropped."""
    lines = [line for line in path.read_text().splitlines() if not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", " ", "\n".join(lines))
    stages: list[list[Instruction]] = []
    for line in filter(None, map(str.strip, joined.splitlines())):
        name, _, value = line.partition(" ")
        if name == "FROM":
            stages.append([])
        stages[-1].append(Instruction(name, value.strip()))
    return stages


def environment(stage: list[Instruction]) -> dict[str, str]:
    words = (word for step in stage if step.name == "ENV" for word in shlex.split(step.value))
    return dict(word.split("=", 1) for word in words)
