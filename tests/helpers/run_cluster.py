"""Two nodes by Ray's own test cluster, in a process of their own, until its input ends; says where they are."""

import json
import sys

from ray.cluster_utils import Cluster

STORE = 100_000_000


def main() -> None:
    cpus, folder = int(sys.argv[1]), sys.argv[2]
    head = {"num_cpus": cpus, "object_store_memory": STORE, "include_dashboard": False, "temp_dir": folder}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    node = cluster.add_node(num_cpus=cpus, object_store_memory=STORE)
    (raylet,) = node.all_processes["raylet"]
    json.dump({"address": cluster.address, "raylet": raylet.process.pid}, sys.stdout)
    sys.stdout.write("\n")
    sys.stdout.flush()
    sys.stdin.read()
    cluster.shutdown()


if __name__ == "__main__":
    main()
