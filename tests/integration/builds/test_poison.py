"""Three poisoned scenes among twenty: exactly those three fail, each with its own kind, wherever the stages run."""

import pytest

from tests.helpers.builds import digests, finish, kill, scenes, start, write_manifest

SCENES = 20
POISON = {3: ("segfault", "crash"), 9: ("hang", "timeout"), 14: ("hog", "out_of_memory")}
RUN = {"deadline_s": 6.0, "shard_size": 4}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The manifest, and where each executor builds it."""
    folder = tmp_path_factory.mktemp("poison")
    names = [POISON[i][0] if i in POISON else "fine" for i in range(SCENES)]
    manifest = write_manifest(folder / "images.parquet", names)
    builds = [start(manifest, folder / executor, executor, 2, **RUN) for executor in ("local", "ray")]
    try:
        for process in builds:  # side by side: most of their time they wait for the scenes that hang
            code, errors = finish(process, 300.0)
            assert code == 0, errors
    finally:
        for process in builds:
            if process.poll() is None:
                kill(process)
    return folder


@pytest.mark.parametrize("executor", ["local", "ray"])
def test_exactly_the_poisoned_fail_with_their_kind_after_their_attempts(built, executor):
    rows = scenes(built / executor)
    assert [row["scene_id"] for row in rows] == [f"scene_{i:03d}" for i in range(SCENES)]
    failed = {i: (row["stage"], row["error_kind"], row["attempts"]) for i, row in enumerate(rows) if row["error_kind"]}
    assert failed == {i: ("cut", kind, 2) for i, (_, kind) in POISON.items()}
    healthy = [(row["status"], row["attempts"]) for i, row in enumerate(rows) if i not in POISON]
    assert set(healthy) == {("done", 1)}


def test_poison_does_not_change_a_byte_of_what_is_beside_it(built):
    assert digests(built / "ray") == digests(built / "local")
