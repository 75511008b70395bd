"""Folders of synthetic captures: each depends on the seed and its own number alone, and is whole or absent."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tableverse_factory.core.errors import InputError
from tableverse_factory.sources.synthetic.capture import encode_capture, write_files
from tableverse_factory.sources.synthetic.scene import SyntheticScene, make_scene

GENERATOR = "tableverse-synth-1"  # Changes whenever the same seed no longer gives the same bytes
MAX_SCENES = 1_000_000
_PARTIAL = ".partial"
_OWN_NAME = re.compile(rf"synth_\d{{6}}|\.?synth_\d{{6}}{re.escape(_PARTIAL)}")


def synthesize_captures(
    out: Path, scenes: int, seed: int, on_scene: Callable[[Path, bool], None] | None = None
) -> list[Path]:
    """Write captures to `out/synth_000000` and so on; existing ones of the same seed are kept.

    Scene k has the same bytes whatever the number of scenes.
    """
    check_numbers(scenes, seed)
    check_output_folder(out, lambda path: path.is_dir() and _OWN_NAME.fullmatch(path.name) is not None)
    out.mkdir(parents=True, exist_ok=True)
    folders = []
    for index in range(scenes):
        folder = out / f"synth_{index:06d}"
        origin = {"generator": GENERATOR, "seed": seed, "scene": folder.name}
        made = not folder.exists()
        if made:
            _write_capture(make_synthetic_scene(seed, index), origin, folder)
        else:
            check_origin(folder, folder / "truth.json", origin, "capture")
        folders.append(folder)
        if on_scene is not None:
            on_scene(folder, made)
    return folders


def check_numbers(scenes: int, seed: int) -> None:
    """Check the number of scenes and the seed."""
    if not 1 <= scenes <= MAX_SCENES:
        raise InputError(f"scenes is {scenes}: give 1 to {MAX_SCENES}")
    if seed < 0:
        raise InputError(f"seed is {seed}: give 0 or more")


def check_output_folder(out: Path, is_own: Callable[[Path], bool]) -> None:
    """Check that a folder is new, or holds nothing but what an earlier call wrote."""
    if out.exists() and not out.is_dir():
        raise InputError(f"{str(out)!r} is a file: give a new or empty folder")
    foreign = sorted(path.name for path in out.iterdir() if not is_own(path)) if out.exists() else []
    if foreign:
        raise InputError(
            f"{str(out)!r} holds other files ({foreign[0]!r}, {len(foreign)} in all): give a new or empty folder"
        )


def check_origin(path: Path, file: Path, wanted: dict[str, Any], kind: str) -> None:
    """Check that an existing capture or layout has the wanted origin."""
    try:
        found = json.loads(file.read_bytes())["origin"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{str(path)!r} is no synthetic {kind} ({error}): give a new or empty folder") from error
    if found != wanted:
        raise InputError(
            f"{str(path)!r} was made by {str(found)[:200]}, wanted is {wanted}: give another folder, or the same seed"
        )


def make_synthetic_scene(seed: int, index: int) -> SyntheticScene:
    """Make scene `index` of a seed in memory."""
    return make_scene(seed, f"synth_{index:06d}")


def _write_capture(scene: SyntheticScene, origin: dict[str, Any], folder: Path) -> None:
    partial = folder.with_name(f".{folder.name}{_PARTIAL}")
    if partial.exists():
        shutil.rmtree(partial)
    partial.mkdir()
    write_files(encode_capture(scene, origin), partial)
    partial.rename(folder)
