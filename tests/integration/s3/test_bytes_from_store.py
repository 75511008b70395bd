"""How many bytes of a store's objects one scene costs."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tableverse_factory.core.storage.files import get_store
from tableverse_factory.dataset.dataset import open_dataset
from tests.helpers.public_dataset import files_of, write_public_dataset, write_shard
from tests.integration.s3.test_store_readers import upload

SCENE_BYTES = 1_000_000
TAR_BYTES = 64_000_000


def test_a_scene_costs_its_own_bytes_and_a_few_rows(store, proxy, tmp_path):
    """Counted: the bodies of all answers, listings and tables too."""
    out = write_public_dataset(tmp_path / "out", scenes=2, n_bytes=SCENE_BYTES)
    write_shard(out, 1, 2, SCENE_BYTES, "CC-BY-4.0", start=TAR_BYTES)
    upload(out, store)
    proxy.passed.clear()
    scene = open_dataset(str(store)).scene("s-1-1")
    assert scene.files() == dict(files_of("s-1-1", SCENE_BYTES))
    size = scene.row["tar_size"]
    assert sum(seen.answered for seen in proxy.passed if ".tar" in seen.path) == size
    assert sum(seen.answered for seen in proxy.passed if seen.method == "GET") < 1.05 * size


def test_a_column_of_a_large_table_does_not_fetch_the_table(store, proxy, tmp_path):
    upload(write_public_dataset(tmp_path / "out", shards=1, scenes=1, n_bytes=10), store)
    random = np.random.default_rng(0)
    rows = {"label": [random.bytes(30).hex() for _ in range(60_000)], "mass_kg": random.random(60_000)}
    sink = pa.BufferOutputStream()
    pq.write_table(pa.table(rows), sink, row_group_size=20_000)
    data = sink.getvalue().to_pybytes()
    get_store(store).pipe_file(f"{store.path}/objects/shard-00000.parquet", data)
    proxy.passed.clear()
    assert open_dataset(str(store)).objects.to_table(columns=["mass_kg"]).num_rows == 60_000
    read = sum(seen.answered for seen in proxy.passed if "objects/" in seen.path and seen.method == "GET")
    assert read < len(data) / 2  # s3fs alone would fetch all of it
