"""Nodes that would give other bytes, or none, are refused before any work: by name, with what they lack."""

import pytest
import ray

from tableverse_factory.core.errors import BuildError, StoreError
from tableverse_factory.core.storage.s3 import ObjectStore
from workers.executors.preflight import (
    NodeExpectation,
    NodeReport,
    check_inputs,
    check_nodes,
    check_shared_folder,
    check_versions,
    collect_versions,
    find_local_problem,
    find_visible_inputs,
    make_expectation,
    probe_node,
    probe_nodes,
    sample_inputs,
    write_shared_token,
)
from workers.executors.ray_cluster import connect, list_alive_nodes

pytestmark = pytest.mark.heavy

OWN = collect_versions()


@pytest.fixture(scope="module")
def nodes():
    connect(None)
    yield list_alive_nodes()
    ray.shutdown()


def answer(**changes) -> NodeReport:
    return NodeReport(**{"node": "10.0.0.7", "versions": OWN, "missing": (), "token": "word", **changes})


def test_a_node_like_this_one_is_let_through():
    check_versions(OWN, [answer()])
    check_inputs(3, [answer()])


@pytest.mark.parametrize(
    ("versions", "says"),
    [
        ({**OWN, "mujoco": "3.3.0"}, rf"node 10\.0\.0\.7 .*mujoco 3\.3\.0 \(here {OWN['mujoco']}\)"),
        ({**OWN, "python": "3.12.1"}, r"python 3\.12\.1 \(here "),
        ({**OWN, "code": "0"}, r"code 0 \(here [0-9a-f]{12}\)"),
        (dict.fromkeys(OWN, "0"), f"and {len(OWN) - 4} more"),
    ],
)
def test_other_versions_are_refused(versions, says):
    with pytest.raises(BuildError, match=says):
        check_versions(OWN, [answer(), answer(versions=versions)])


def test_inputs_that_a_node_cannot_see_are_refused():
    with pytest.raises(BuildError, match=r"node 10\.0\.0\.7 does not see 1 of 3 inputs tried, among them /data/1"):
        check_inputs(3, [answer(missing=("/data/1",))])


def test_a_folder_of_the_same_name_is_not_the_same_folder(tmp_path):
    with pytest.raises(
        BuildError, match=r"10\.0\.0\.7, 10\.0\.0\.8 cannot read what was written to .*give a folder that every"
    ):
        check_shared_folder(
            tmp_path, "word", [NodeReport("10.0.0.7", {}, (), ""), NodeReport("10.0.0.8", {}, (), "other"), answer()]
        )


def test_the_token_is_there_only_while_it_is_needed(tmp_path):
    with write_shared_token(tmp_path) as (path, word):
        assert probe_node("here", (), str(path)).token == word
    assert list(tmp_path.iterdir()) == []
    assert probe_node("here", (), str(path)).token == ""


def test_what_the_driver_cannot_see_either_is_no_fault_of_the_nodes(tmp_path):
    (tmp_path / "capture").mkdir()
    (tmp_path / "layout.json").write_text("{}")
    seen = [str(tmp_path / "capture"), str(tmp_path / "layout.json"), (tmp_path / "capture").as_uri()]
    assert find_visible_inputs([*seen, str(tmp_path / "gone"), "nosuch://bucket/x"]) == tuple(seen)


@pytest.mark.parametrize("n", [0, 1, 15, 16, 17, 1000])
def test_a_few_inputs_are_tried_from_first_to_last(n):
    tried = sample_inputs([str(i) for i in range(n)])
    assert min(n, 8) <= len(tried) <= 16
    assert tried[:1] == (("0",) if n else ())
    assert not tried or int(tried[-1]) >= n - n // 8 - 1


@pytest.mark.slow  # starts Ray; test_ray_build.py has a build that asks its node
def test_a_real_node_is_asked(nodes, tmp_path):
    check_nodes(nodes, [str(tmp_path)], tmp_path)
    (found,) = probe_nodes(nodes, ["/nowhere/at/all"], tmp_path / "gone")
    assert found.versions == collect_versions()
    assert found.missing == ("/nowhere/at/all",)


def test_a_manifest_that_was_made_elsewhere_is_refused(nodes, tmp_path):
    with pytest.raises(BuildError, match=r"none of 2 inputs tried can be seen from here, .*, /gone/0 first"):
        check_nodes(nodes, ["/gone/0", "/gone/1"], tmp_path)


def test_a_node_that_is_gone_is_left_out(nodes, tmp_path):
    gone = [*nodes, type(nodes[0])("1" * 56, "10.9.9.9", {})]
    assert [found.node for found in probe_nodes(gone, [], tmp_path)] == [nodes[0].name]


def test_actors_on_nodes_that_answered_before_the_build_are_not_asked_again(nodes, tmp_path):
    (tmp_path / "a").mkdir()
    expected = make_expectation([str(tmp_path / "a")], nodes)
    (tmp_path / "a").rmdir()
    assert find_local_problem("10.0.0.7", nodes[0].node_id, expected) == ""
    assert "node 10.0.0.7 does not see 1 of 1 inputs" in find_local_problem("10.0.0.7", "1" * 56, expected)


@pytest.fixture
def silent_store(monkeypatch):
    """The inputs' store, which nobody answers for."""
    monkeypatch.setattr("tableverse_factory.core.storage.s3._ATTEMPTS", 1)
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    for name in ("ACCESS_KEY_ID", "SECRET_ACCESS_KEY"):
        monkeypatch.setenv(f"AWS_{name}", "test")
    ObjectStore.clear_instance_cache()
    yield "s3://bucket/captures/one"
    ObjectStore.clear_instance_cache()


def test_a_store_that_does_not_answer_is_no_missing_input(silent_store):
    for ask_it in (
        lambda: find_visible_inputs([silent_store]),
        lambda: probe_node("here", [silent_store], ""),
        lambda: find_local_problem("here", "1" * 56, NodeExpectation(OWN, (silent_store,))),
    ):
        with pytest.raises(StoreError, match="s3://bucket/captures/one: the store does not answer"):
            ask_it()
