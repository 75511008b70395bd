"""What is asked of a cluster is compared with what it has, before anything waits for it."""

import pytest

from tableverse_factory.core.errors import BuildError
from workers.executors.ray_cluster import Node, check_workers

NODES = [Node("a", "one", {"CPU": 2.0}), Node("b", "two", {"CPU": 4.0, "GPU": 1.0})]


def test_more_workers_than_the_cluster_has_are_refused_with_how_many_there_may_be():
    for enough in (None, 1, 6):
        check_workers(enough, NODES)
    with pytest.raises(BuildError, match=r"^7 workers need 7 CPUs and the cluster has 6: give --workers 6$"):
        check_workers(7, NODES)
    with pytest.raises(BuildError, match=r"has 0: give --workers 1$"):
        check_workers(1, [])
