"""Arguments of ``bathyscope evaluate``, arranged so that one command serves all ways of asking.

::

    bathyscope evaluate FOLDER...                               a bundle on folders, at once
    bathyscope evaluate --protocol P --data D... --systems S... a whole evaluation
    bathyscope evaluate diff A B                                two evaluations, frame by frame
    bathyscope evaluate trajectory TRUE PREDICTED               two trajectories
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from typer.core import TyperGroup

MANY = ("--data", "--systems", "--compat", "--change")
"""Options that take all words up to the next option."""
_WHOLE = {"--data", "--systems", "--protocol"}


class EvaluateGroup(TyperGroup):
    """Finds out which of its commands is meant where none is named."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        return super().parse_args(ctx, arranged(args, self.commands))


def arranged(args: Sequence[str], commands: Sequence[str] | Any) -> list[str]:
    """Arguments with the command first, and options of many values repeated for each of them."""
    if args and (args[0] in commands or args[0] == "--help"):
        return spread(args)
    whole = any(word.split("=")[0] in _WHOLE for word in args)
    return spread(["tables" if whole else "folders", *args])


def spread(args: Sequence[str]) -> list[str]:
    """``--data a b`` becomes ``--data a --data b``."""
    found: list[str] = []
    option, values = None, 0
    for word in args:
        if word.startswith("--"):
            option, values = (word if word in MANY else None), 0
        elif option is not None:
            values += 1
            if values > 1:
                found.append(option)
        found.append(word)
    return found
