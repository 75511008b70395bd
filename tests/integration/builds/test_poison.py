"""Three poisoned scenes among forty: exactly those three fail, each with its own kind, wherever the stages run."""

import pytest

from tests.helpers.builds import digests, finish, scenes, start, write_manifest

POISON = {7: ("segfault", "crash"), 18: ("hang", "timeout"), 29: ("hog", "out_of_memory")}
RUN = {"deadline_s": 6.0, "shard_size": 8}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The manifest, and where each executor builds it."""
    folder = tmp_path_factory.mktemp("poison")
    names = [POISON[i][0] if i in POISON else "fine" for i in range(40)]
    manifest = write_manifest(folder / "images.parquet", names)
    for executor in ("local", "ray"):
        code, errors = finish(start(manifest, folder / executor, executor, 2, **RUN), 300.0)
        assert code == 0, errors
    return folder


@pytest.mark.parametrize("executor", ["local", "ray"])
def test_exactly_the_poisoned_fail_with_their_kind_after_their_attempts(built, executor):
    rows = scenes(built / executor)
    assert [row["scene_id"] for row in rows] == [f"scene_{i:03d}" for i in range(40)]
    failed = {i: (row["stage"], row["error_kind"], row["attempts"]) for i, row in enumerate(rows) if row["error_kind"]}
    assert failed == {i: ("cut", kind, 2) for i, (_, kind) in POISON.items()}
    healthy = [(row["status"], row["attempts"]) for i, row in enumerate(rows) if i not in POISON]
    assert set(healthy) == {("done", 1)}


def test_poison_does_not_change_a_byte_of_what_is_beside_it(built):
    assert digests(built / "ray") == digests(built / "local")
