"""Settings in YAML files, and ``name=value`` on the command line to replace some of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from bathyscope.errors import SettingsError


def read_settings_file(path: Path, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """The mapping of a YAML file; an override ``name=value`` replaces a field, ``loss.name=value`` one inside it.

    Raises:
        SettingsError: If the file or an override cannot be read.
    """
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise SettingsError(f"{path}: cannot read settings: {error}") from error
    if not isinstance(values, dict):
        raise SettingsError(f"{path}: settings must be a mapping, got {type(values).__name__}")
    for override in overrides:
        replace_setting(values, override)
    return values


def replace_setting(values: dict[str, Any], override: str) -> None:
    """Replace one field of nested ``values``, in place.

    Raises:
        SettingsError: If ``override`` is not ``name=value``, the value is not YAML, or a name on the way to it holds
            a plain value.
    """
    name, separator, text = override.partition("=")
    if not separator or not name:
        raise SettingsError(f"override {override!r} is not of the form name=value")
    *parents, leaf = name.split(".")
    for parent in parents:
        inner = values.setdefault(parent, {})
        if not isinstance(inner, dict):
            raise SettingsError(f"override {override!r}: {parent!r} holds {inner!r}, which has no settings inside it")
        values = inner
    try:
        values[leaf] = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise SettingsError(f"override {override!r}: {text!r} is not a YAML value: {error}") from error
