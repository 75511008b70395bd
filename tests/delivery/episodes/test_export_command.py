"""`tableverse export`: its commands, and that its old form still means what it meant."""

import pytest

from tableverse_factory.cli.main import app


@pytest.mark.parametrize("words", [(), ("dataset",), ("--profile", "share-alike")])
def test_without_a_command_a_dataset_is_passed_on(run, tmp_path, words):
    code, said, error = run("export", *words, tmp_path / "nowhere", tmp_path / "there")
    assert (code, said) == (1, "")
    assert "there is no such folder" in error


@pytest.mark.heavy
def test_both_formats_are_written_and_counted(run, out, tmp_path):
    small = ("--width", "32", "--height", "24", "--fps", "4", "--picture", "front")
    code, said, _ = run("export", "lerobot", out, tmp_path / "made", *small)
    assert (code, said) == (0, f"2 episodes, 16 frames of front, in {tmp_path / 'made'}\n")
    code, said, _ = run("export", "robomimic", out, tmp_path / "made.hdf5", "--failed")
    assert (code, said) == (0, f"3 demonstrations, 103 samples, in {tmp_path / 'made.hdf5'}\n")


def test_an_error_is_a_line_with_a_link(run, out, tmp_path):
    code, said, error = run("export", "lerobot", out, tmp_path)
    assert (code, said) == (1, "")
    assert error.startswith(f"error: {tmp_path}: already there; give a new name\nhelp: ")


def test_the_group_is_one_command_of_tableverse():
    assert [group.name for group in app.registered_groups].count("export") == 1
