"""What lies in deploy/ and docs/cluster.md: every command is one that the command line takes, every file holds."""

import json
import re
import shlex
import subprocess

import pytest
import typer
import yaml
from ray.autoscaler._private.util import prepare_config, validate_config

from schemas.pools import Pools
from tableverse_factory.cli.main import app
from tests.helpers.paths import ROOT

DEPLOY = ROOT / "deploy"
NON_ROOT = 10001


def constraints() -> dict[str, str]:
    return dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().split())


def parse(words: list[str]) -> None:
    """What the command line makes of it; nothing is run."""
    command, words = typer.main.get_command(app), words[1:]
    while hasattr(command, "commands"):
        command, words = command.commands[words[0]], words[1:]
    command.make_context(command.name, list(words))


def commands_in(text: str) -> list[list[str]]:
    """Every `tableverse …` that stands alone on a line, behind a comment's `#` or in an `sh -c`."""
    text = re.sub(r"\\\n\s*#?", " ", text)
    lines = [line.strip().lstrip("#").strip().split("  #")[0] for line in text.splitlines()]
    return [shlex.split(line.replace("…", "")) for line in lines if re.match(r"tableverse [a-z]", line)]


@pytest.mark.parametrize("path", ["deploy/ray-cluster.yaml", "deploy/pools-gpu.yaml", "docs/cluster.md"])
def test_every_command_shown_is_understood(path):
    for words in commands_in((ROOT / path).read_text()):
        parse(words)


def test_the_slurm_script_passes_options_of_the_build():
    script = (DEPLOY / "slurm.sbatch").read_text()
    subprocess.run(["bash", "-n", DEPLOY / "slurm.sbatch"], check=True)
    (build,) = re.findall(r"tableverse build .*--address \S+", script)
    parse(shlex.split(build.replace('"$@"', "images.parquet out").replace("$head:$port", "node1:20001")))
    directives = dict(re.findall(r"^#SBATCH --([a-z-]+)=?(.*)$", script, re.MULTILINE))
    assert "requeue" in directives
    assert re.fullmatch(r"B:TERM@\d+", directives["signal"])
    assert "ray stop" not in script, "it would end other jobs' Ray on a shared node"
    assert "RAY_AUTH_MODE=token" in script


def test_pools_are_pools():
    pools = Pools.model_validate(yaml.safe_load((DEPLOY / "pools-gpu.yaml").read_text()))
    assert 0 < pools.perception.gpus <= 0.05, "weights lie in one process on each GPU, not in the actors"
    assert pools.geometry.gpus == pools.physics.gpus == pools.curation.gpus == 0


def test_the_cluster_launcher_takes_its_file():
    config = yaml.safe_load((DEPLOY / "ray-cluster.yaml").read_text())
    prepared = prepare_config(json.loads(json.dumps(config)))
    validate_config(prepared)
    types = config["available_node_types"]
    assert config["head_node_type"] in types
    assert types["head"]["resources"] == {"CPU": 0}
    assert config["max_workers"] >= sum(kind["max_workers"] for kind in types.values())
    assert all("RAY_AUTH_MODE=token" in config[f"{kind}_start_ray_commands"][-1] for kind in ("head", "worker"))
    for image in (config["docker"]["head_image"], types["gpu"]["docker"]["worker_image"]):
        assert re.search(r"tableverse-factory:(cpu|gpu)$", image)


class TestRayJob:
    """The Kubernetes job; its fields are those of KubeRay 1.5, by name."""

    JOB = yaml.safe_load((DEPLOY / "kuberay-rayjob.yaml").read_text())
    FIELDS = frozenset(
        {"entrypoint", "backoffLimit", "shutdownAfterJobFinishes", "ttlSecondsAfterFinished", "rayClusterSpec"}
    )
    CLUSTER = frozenset({"rayVersion", "authOptions", "headGroupSpec", "workerGroupSpecs"})
    GROUP = frozenset({"groupName", "replicas", "minReplicas", "maxReplicas", "rayStartParams", "template"})

    @property
    def cluster(self):
        return self.JOB["spec"]["rayClusterSpec"]

    @property
    def pods(self):
        groups = [self.cluster["headGroupSpec"], *self.cluster["workerGroupSpecs"]]
        return [group["template"]["spec"] for group in groups]

    def test_fields(self):
        assert (self.JOB["apiVersion"], self.JOB["kind"]) == ("ray.io/v1", "RayJob")
        assert set(self.JOB["spec"]) <= self.FIELDS
        assert set(self.cluster) <= self.CLUSTER
        for group in self.cluster["workerGroupSpecs"]:
            assert set(group) <= self.GROUP
            assert group["minReplicas"] == group["replicas"] == group["maxReplicas"], "pools are sized at the start"
        starts = [self.cluster["headGroupSpec"], *self.cluster["workerGroupSpecs"]]
        assert all(isinstance(value, str) for group in starts for value in group["rayStartParams"].values())

    def test_its_ray_is_the_one_that_is_installed(self):
        assert self.cluster["rayVersion"] == constraints()["ray"]

    def test_the_token_is_on(self):
        assert self.cluster["authOptions"] == {"mode": "token"}

    def test_a_retry_is_the_same_command_and_a_build_with_failed_scenes_is_complete(self):
        shell, flag, line = shlex.split(self.JOB["spec"]["entrypoint"])
        assert (shell, flag) == ("sh", "-c")
        build, tail = line.split(" || ")
        parse(shlex.split(build))
        assert "s3://bucket/out" in build
        assert self.JOB["spec"]["backoffLimit"] >= 3
        for code, expected in [(0, 0), (3, 0), (1, 1), (143, 1)]:
            assert subprocess.run(["sh", "-c", f"(exit {code}) || {tail}"], check=False).returncode == expected

    def test_no_pod_is_root_and_none_gains_rights(self):
        for pod in self.pods:
            assert pod["automountServiceAccountToken"] is False
            assert pod["securityContext"]["runAsNonRoot"] is True
            assert pod["securityContext"]["runAsUser"] == NON_ROOT
            for container in pod["containers"]:
                assert container["securityContext"] == {
                    "allowPrivilegeEscalation": False,
                    "capabilities": {"drop": ["ALL"]},
                }

    def test_secrets_are_named_not_written(self):
        for pod in self.pods:
            for variable in pod["containers"][0]["env"]:
                if re.search("KEY|SECRET|TOKEN", variable["name"]):
                    assert variable["valueFrom"]["secretKeyRef"]["key"] == variable["name"]

    def test_memory_is_bounded_and_mounts_have_their_volumes(self):
        for pod in self.pods:
            volumes = {volume["name"] for volume in pod["volumes"]}
            for container in pod["containers"]:
                resources = container["resources"]
                assert resources["limits"]["memory"] == resources["requests"]["memory"]
                assert {mount["name"] for mount in container["volumeMounts"]} <= volumes

    def test_gpus_are_only_where_the_gpu_image_is(self):
        for pod in self.pods:
            (container,) = pod["containers"]
            assert ("nvidia.com/gpu" in container["resources"]["limits"]) == container["image"].endswith(":gpu")


def test_the_pools_of_the_example_fit_the_workers_of_both_clusters():
    from workers.executors.pool_capacity import check_pools
    from workers.executors.ray_cluster import Node

    pools = Pools.model_validate(yaml.safe_load((DEPLOY / "pools-gpu.yaml").read_text()))
    specs = {name: getattr(pools, name) for name in Pools.model_fields}
    groups = TestRayJob().cluster["workerGroupSpecs"]
    nodes = [
        Node(f"{group['groupName']}-{i}", group["groupName"], _resources(group))
        for group in groups
        for i in range(group["replicas"])
    ]
    check_pools(
        specs, nodes, {name: sum(node.resources.get(name, 0) for node in nodes) for name in ("CPU", "GPU", "memory")}
    )


def _resources(group: dict) -> dict[str, float]:
    limits = group["template"]["spec"]["containers"][0]["resources"]["limits"]
    gigabytes = float(limits["memory"].removesuffix("Gi")) * 2**30
    return {"CPU": float(limits["cpu"]), "GPU": float(limits.get("nvidia.com/gpu", 0)), "memory": 0.7 * gigabytes}
