"""The plan of a build: what was written is what is read, every scene is found, and the digest is that of the rows."""

import hashlib
import json

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.manifest import ImageRow, SceneKind
from tableverse_factory.core.errors import BuildError
from tableverse_factory.dataset import columns
from tableverse_factory.dataset.shard_plan import Plan, digest_manifest, make_plan, read_plan, write_plan

IDS = st.lists(st.from_regex(r"[a-z][a-z0-9]{0,5}", fullmatch=True), unique=True, max_size=40)
TEXT = st.text(st.characters(codec="utf-8"), max_size=20)
ROWS = st.lists(
    st.builds(ImageRow, scene_id=st.just("a"), kind=st.sampled_from(SceneKind), uri=TEXT, name=TEXT, url=TEXT),
    max_size=8,
)


def rows_of(ids):
    kinds = list(SceneKind)
    return [ImageRow(scene_id=name, kind=kinds[rank % len(kinds)], uri="/x") for rank, name in enumerate(ids)]


@given(IDS, st.integers(1, 7))
def test_a_plan_is_read_as_it_was_made(tmp_path_factory, ids, shard_size):
    plan, path = make_plan(rows_of(ids), shard_size), tmp_path_factory.mktemp("plan") / "plan.parquet"
    write_plan(path, plan)
    again = read_plan(path)
    assert again == plan == Plan(list(plan.scene_ids), list(plan.kinds), list(plan.shards))
    assert list(again.scene_ids) == ids
    assert [again.scene_ids[rank] for rank in range(len(ids))] == ids
    assert again.n_shards == -(-len(ids) // shard_size)
    assert [[plan.shards[rank] for rank in ranks] for ranks in again.members()] == [
        [shard] * len(ids[shard * shard_size :][:shard_size]) for shard in range(again.n_shards)
    ]
    assert [rank for ranks in again.members() for rank in ranks] == list(range(len(ids)))
    assert [again.rank_of(name) for name in ids] == list(range(len(ids)))
    assert [kind for kind in SceneKind if kind.value in plan.kinds] == list(SceneKind)[: len(ids)]


def test_another_plan_is_not_equal_and_an_unknown_scene_is_not_found():
    plan = Plan(["a", "b"], ["image", "image"], [0, 0])
    others = (Plan(["a", "b"], ["image", "image"], [0, 1]), Plan(["a", "c"], ["image"] * 2, [0, 0]), Plan([], [], []))
    assert all(plan != other for other in (*others, Plan(["a", "b"], ["image", "layout"], [0, 0]), None))
    with pytest.raises(KeyError):
        plan.rank_of("c")


def test_ids_with_one_hash_are_told_apart(monkeypatch):
    monkeypatch.setattr(columns, "hash", lambda text: len(text), raising=False)
    plan = Plan(["aa", "b", "cc", "d", "eee"], ["image"] * 5, [0] * 5)
    assert [plan.rank_of(name) for name in plan.scene_ids] == list(range(5))
    assert columns.HashIndex(plan.scene_ids).find_shared() == [0, 1, 2, 3]


@given(ROWS)
def test_the_digest_is_that_of_the_rows_as_json(rows):
    digest = hashlib.sha256()
    for row in rows:
        lacks = {name for name in ("url", "known_length", "parent", "family", "recipe") if not getattr(row, name)}
        content = row.model_dump(mode="json", exclude=lacks)
        digest.update(json.dumps(content, sort_keys=True).encode() + b"\n")
    assert digest_manifest(rows) == digest.hexdigest()


@pytest.mark.parametrize("shards", [[1, 0], [0, None], [-1, 0]])
def test_what_is_no_plan_is_refused(tmp_path, shards):
    path = tmp_path / "plan.parquet"
    table = {"scene_id": ["a", "b"], "kind": ["image"] * 2, "shard": pa.array(shards, pa.int32())}
    pq.write_table(pa.table(table), path)
    with pytest.raises(BuildError, match=r"plan\.parquet is no plan"):
        read_plan(path)
