"""The folders: the same bytes from the same seed, whatever the number, the process, or an interruption."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tableverse_factory.core.errors import InputError
from tableverse_factory.sources.synthetic.synthesize import synthesize_captures

COMMAND = "import typer; from tableverse_factory.cli.synth import synth; typer.run(synth)"


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def run_command(*arguments: str, hash_seed: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONHASHSEED": hash_seed, "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, "-c", COMMAND, *arguments],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.mark.heavy
def test_same_bytes_in_another_process_fewer_scenes_and_after_an_interruption(
    synthetic_folders: list[Path], tmp_path: Path
) -> None:
    out = tmp_path / "again"
    done = run_command(str(out), "--scenes", "1", "--seed", "3", hash_seed="77")
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"1 capture in {out}\n"
    assert contents(out / "synth_000000") == contents(synthetic_folders[0])
    # A second call that was killed half-way leaves a partial folder; the next goes on and replaces it.
    (out / ".synth_000001.partial" / "truth").mkdir(parents=True)
    (out / ".synth_000001.partial" / "color.png").write_bytes(b"half a file")
    made = []
    synthesize_captures(out, 2, 3, lambda folder, new: made.append((folder.name, new)))
    assert made == [("synth_000000", False), ("synth_000001", True)]
    assert sorted(path.name for path in out.iterdir()) == ["synth_000000", "synth_000001"]
    assert contents(out / "synth_000001") == contents(synthetic_folders[1])


def test_scenes_differ(synthetic_folders: list[Path]) -> None:
    assert contents(synthetic_folders[0])["truth.json"] != contents(synthetic_folders[1])["truth.json"]


def test_another_seed_does_not_mix_with_what_is_there(synthetic_folders: list[Path]) -> None:
    with pytest.raises(InputError, match="same seed"):
        synthesize_captures(synthetic_folders[0].parent, 1, 4)


@pytest.mark.parametrize("name", ["photo.jpg", "synth_000000.txt", "synth_0", "..partial"])
def test_a_folder_of_other_things_is_left_alone(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"mine")
    with pytest.raises(InputError, match="holds other files"):
        synthesize_captures(tmp_path, 1, 0)
    assert contents(tmp_path) == {name: b"mine"}


def test_a_folder_that_only_looks_like_ours_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "synth_000000").mkdir()
    (tmp_path / "synth_000000" / "truth.json").write_text("[]")
    with pytest.raises(InputError, match="no synthetic capture"):
        synthesize_captures(tmp_path, 1, 0)


def test_numbers_out_of_range_and_a_file_are_refused(tmp_path: Path) -> None:
    for scenes, seed in ((0, 0), (-1, 0), (10**9, 0), (1, -1)):
        with pytest.raises(InputError, match="give"):
            synthesize_captures(tmp_path / "new", scenes, seed)
    assert not (tmp_path / "new").exists()
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(InputError, match="is a file"):
        synthesize_captures(tmp_path / "file", 1, 0)
