"""Differences between a checkpoint's training and the one that would go on with it."""

from collections.abc import Mapping
from pathlib import Path

from tableverse_factory.core.file_hash import hash_file
from tableverse_factory.core.text import describe_change, sanitize_line

Inputs = Mapping[str, tuple[str, str]]  # path and SHA-256 of each file that a training reads, by what it is


def hash_inputs(files: Mapping[str, Path | None]) -> Inputs:
    """Hash the files that a training reads, but for those that it does without."""
    return {name: (str(path), hash_file(path)) for name, path in files.items() if path is not None}


def describe_settings(before: Mapping[str, object], now: Mapping[str, object]) -> list[str]:
    """Describe the settings that differ, each with both values."""
    return [
        describe_change(name, before.get(name), now.get(name))
        for name in {**before, **now}
        if before.get(name) != now.get(name)
    ]


def describe_inputs(before: Inputs, now: Inputs) -> list[str]:
    """Describe the files that differ in content, each with both paths and the starts of their digests."""
    pairs = {name: (before.get(name), now.get(name)) for name in {**before, **now}}
    return [
        f"{name} was {_name_file(old)} and is now {_name_file(new)}"
        for name, (old, new) in pairs.items()
        if (old and old[1]) != (new and new[1])
    ]


def _name_file(file: tuple[str, str] | None) -> str:
    return f"{sanitize_line(file[0], 160)} (sha256 {sanitize_line(file[1][:12])})" if file else "none"
