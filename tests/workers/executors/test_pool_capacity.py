"""Pools against nodes: what can never be placed is refused with the pool, what it wants, what is there, what to do."""

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.pools import PoolSpec
from tableverse_factory.core.errors import BuildError
from workers.executors.pool_capacity import check_pools, compute_pool_limits, count_actors
from workers.executors.ray_cluster import Node

LAPTOP = Node("a", "10.0.0.1", {"CPU": 2.0, "memory": 8e9})
GPU_NODE = Node("b", "10.0.0.2", {"CPU": 4.0, "GPU": 2.0, "memory": 32e9, "accelerator_type:H200": 1.0})


def check_all(specs: dict[str, PoolSpec], nodes: list[Node]) -> None:
    """With all that the nodes have."""
    capacity: Counter[str] = Counter()
    for node in nodes:
        capacity.update(node.resources)
    check_pools(specs, nodes, capacity)


def test_what_fits_is_let_through():
    check_all({"geometry": PoolSpec(cpus=2)}, [LAPTOP])
    check_all({"perception": PoolSpec(gpus=0.5, min=4), "geometry": PoolSpec(cpus=1, min=2)}, [LAPTOP, GPU_NODE])


@pytest.mark.parametrize(
    ("spec", "nodes", "says"),
    [
        (
            PoolSpec(gpus=1),
            [LAPTOP],
            "pool p wants 1 GPU on one node and the largest node has 0 GPUs: lower gpus of p in --pools",
        ),
        (PoolSpec(cpus=5), [LAPTOP, GPU_NODE], "wants 5 CPUs on one node and the largest node has 4 CPUs"),
        (PoolSpec(memory_mb=64_000), [GPU_NODE], "wants 64000 MB of memory on one node.*has 32000 MB.*lower memory_mb"),
        (PoolSpec(resources={"licence": 1}), [GPU_NODE], r"wants 1 of licence .* has 0 of licence: lower resources\."),
        (
            PoolSpec(cpus=3, resources={"fast": 1}),
            [Node("a", "one", {"CPU": 2.0, "fast": 1.0}), GPU_NODE],
            r"no node has all of it: one has 2 CPUs and 1 of fast; 10\.0\.0\.2 has 4 CPUs and 0 of fast",
        ),
        (PoolSpec(gpus=0.6, min=3), [GPU_NODE], r"at least 3 actors with 1 CPU and 0\.6 GPUs each .* room for 2"),
        (PoolSpec(cpus=1), [], "wants 1 CPU on one node and the largest node has 0 CPUs"),
    ],
)
def test_what_does_not_fit_is_refused_and_says_why(spec, nodes, says):
    with pytest.raises(BuildError, match=says):
        check_all({"p": spec}, nodes)


def test_an_actor_never_spans_two_nodes():
    with pytest.raises(BuildError, match="wants 3 CPUs on one node and the largest node has 2 CPUs"):
        check_all({"p": PoolSpec(cpus=3)}, [LAPTOP, LAPTOP])


def test_pools_that_fit_alone_but_not_together_are_refused():
    specs = {"perception": PoolSpec(cpus=1, min=2), "physics": PoolSpec(cpus=1, min=1)}
    with pytest.raises(BuildError, match=r"perception, physics together want 3 CPUs .* may use 2 CPUs"):
        check_all(specs, [LAPTOP])


def test_a_build_that_may_not_use_the_whole_cluster_is_held_to_its_part():
    specs = {"perception": PoolSpec(), "physics": PoolSpec(cpus=0.5)}
    check_pools(specs, [LAPTOP], {"CPU": 1.5})
    with pytest.raises(BuildError, match=r"want 1\.5 CPUs .* may use 1 CPU: .* more --workers"):
        check_pools(specs, [LAPTOP], {"CPU": 1.0})


def test_actors_that_hold_no_cpu_are_no_more_than_the_workers_that_were_asked_for():
    without = PoolSpec(cpus=0, memory_mb=100, min=3)
    assert compute_pool_limits(without, [LAPTOP, GPU_NODE], None).max_workers == 400
    assert compute_pool_limits(without, [LAPTOP, GPU_NODE], 4).max_workers == 4
    assert compute_pool_limits(without.model_copy(update={"max": 3}), [LAPTOP], 4).max_workers == 3
    assert compute_pool_limits(PoolSpec(cpus=0.5), [LAPTOP], 2).max_workers == 4, "of these the CPUs count"
    check_pools({"p": without}, [LAPTOP], LAPTOP.resources, workers=3)
    with pytest.raises(
        BuildError, match=r"p wants at least 3 actors and --workers is 2: set min of p to 2 .* --workers 3"
    ):
        check_pools({"p": without}, [LAPTOP], LAPTOP.resources, workers=2)


@given(gpus=st.integers(0, 16), need=st.sampled_from([0.1, 0.2, 0.25, 0.3, 0.5, 0.6, 1.0, 2.0]))
def test_fractions_of_a_gpu_add_up_on_each_gpu(gpus, need):
    held = count_actors({"GPU": float(gpus)}, {"GPU": need})
    per_gpu = sum(1 for k in range(1, 11) if round(k * need, 6) <= 1.0)
    assert held == (gpus * per_gpu if need < 1 else gpus // int(need))
