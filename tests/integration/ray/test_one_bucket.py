"""Two nodes that share nothing but a bucket: the real line on real captures gives the bytes of one process."""

import subprocess
import time
from pathlib import Path

import pytest
from s3fs import S3FileSystem

from tableverse_factory.sources.synthetic.synthesize import synthesize_captures
from tests.helpers.builds import digests, scenes
from tests.helpers.clusters import BIN, actors_below, clean_environment, end, ray_head, ray_node, without
from tests.helpers.s3_server import s3_server

pytestmark = pytest.mark.slow

N_SCENES = 3
LIMIT_S = 500.0


def test_a_build_of_two_nodes_reads_and_writes_one_bucket_only(tmp_path):
    with s3_server() as endpoint:
        keys = store_keys(endpoint)
        fill(tmp_path / "here", keys)
        run("build", "s3://bucket/images.parquet", tmp_path / "local", "--executor", "local", home=tmp_path, **keys)

        with ray_head(1, HOME=str(home(tmp_path, "one")), **keys) as head:
            other = head.folder / "second"
            environment = clean_environment(**head.environment, **keys, HOME=str(other), TMPDIR=str(other))
            alone = without(tmp_path)  # where it lies, the second node has an empty folder
            with ray_node(other, [f"--address={head.address}"], 1, environment, alone) as second:
                words = ["submit", "s3://bucket/images.parquet", "s3://bucket/out", "--wait", "--address", head.jobs]
                process = start(*words, home=tmp_path, **head.environment)
                try:
                    assert took_part(second.pid, process), "the second node has no part in it"
                    said, _ = process.communicate(timeout=LIMIT_S)
                finally:
                    end(process)
        assert process.returncode == 0, said
        store(keys).get("bucket/out", str(tmp_path / "fetched"), recursive=True)
    assert digests(tmp_path / "fetched") == digests(tmp_path / "local")
    assert len(scenes(tmp_path / "fetched")) == N_SCENES


def store_keys(endpoint: str) -> dict[str, str]:
    return {
        "AWS_ENDPOINT_URL": endpoint,
        "AWS_ACCESS_KEY_ID": "k",
        "AWS_SECRET_ACCESS_KEY": "s",
        "AWS_DEFAULT_REGION": "us-east-1",
    }


def store(keys: dict[str, str]) -> S3FileSystem:
    client = {"endpoint_url": keys["AWS_ENDPOINT_URL"]}
    return S3FileSystem(key=keys["AWS_ACCESS_KEY_ID"], secret=keys["AWS_SECRET_ACCESS_KEY"], client_kwargs=client)


def fill(folder: Path, keys: dict[str, str]) -> None:
    """Captures and their manifest in a new bucket."""
    synthesize_captures(folder / "captures", N_SCENES, seed=11)
    store(keys).mkdir("bucket")
    store(keys).put(str(folder / "captures"), "bucket/captures", recursive=True)
    run("manifest", "s3://bucket/captures", "--out", "s3://bucket/images.parquet", home=folder, **keys)


def took_part(node: int, process: subprocess.Popen) -> bool:
    """Whether actors live below the node before the process ends."""
    until = time.monotonic() + LIMIT_S
    while process.poll() is None and time.monotonic() < until:
        if actors_below(node):
            return True
        time.sleep(0.2)
    return False


def run(*words: object, home: Path, **environment: str) -> None:
    process = start(*words, home=home, **environment)
    said, _ = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0, said


def start(*words: object, home: Path, **environment: str) -> subprocess.Popen:
    return subprocess.Popen(
        [str(BIN / "tableverse"), *map(str, words)],
        env=clean_environment(HOME=str(home), **environment),
        cwd=home,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )


def home(folder: Path, name: str) -> Path:
    (folder / name).mkdir()
    return folder / name
