"""The overview: counts that add up, the same bytes, hostile names, nothing at all, and many shards."""

import json
from xml.etree import ElementTree

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from schemas.tables import TABLES
from tableverse_factory import open_dataset
from tableverse_factory.cli.main import app
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.shards import shard_path
from tableverse_factory.viz.funnel import SceneLoss
from tableverse_factory.viz.overview.dataset_statistics import MASS_EDGES_KG, TOP, compute_statistics
from tableverse_factory.viz.overview.figure import draw_overview, sanitize_label
from tableverse_factory.viz.overview.write import write_statistics
from tests.helpers.small_dataset import write_small_dataset

pytestmark = pytest.mark.heavy

HOSTILE = (
    "$x^2$ {\\frac",
    "日本の湯呑み",
    "<script>alert(1)</script>",
    "a\x1b[2Jb\x07",
    "x" * 100_000,
    "\u202eevil",
    "",
)


def write_rows(out, shards):
    """A dataset of these rows: a mapping of table to columns for each shard, absent columns null."""
    out.mkdir()
    (out / "run.json").write_text("{}")
    for number, tables in enumerate(shards):
        for name, schema in TABLES.items():
            columns = tables.get(name, {})
            n = len(next(iter(columns.values()), []))
            arrays = [pa.array(columns.get(f.name, [None] * n), from_pandas=True).cast(f.type) for f in schema]
            path = shard_path(out, name, number)
            path.parent.mkdir(exist_ok=True)
            pq.write_table(pa.table(arrays, schema=schema), path)
    return open_dataset(out)


def test_counts_are_those_of_the_committed_rows(tmp_path):
    found = compute_statistics(open_dataset(write_small_dataset(tmp_path / "out")))
    assert found.scenes == {"entered": 5, "done": 3, "dropped": 1, "failed": 1, "usable": 3}
    assert found.objects["total"] == 9
    assert found.labels.total == 9
    assert dict(found.labels.top)["red mug"] == 3
    assert found.losses == (
        SceneLoss("place", "failed", "crash", 1),
        SceneLoss("settle", "dropped", "not_at_rest", 1),
    )
    assert found.tasks == {"accepted": 3, "refused": 0}
    assert sum(found.objects_per_scene.counts) == 3
    assert found.masses_kg.missing == 3
    assert sum(found.masses_kg.counts) == 6


def test_histograms_lose_nothing_and_put_an_edge_into_the_bin_above(tmp_path):
    edge = MASS_EDGES_KG[5]
    masses = [edge, np.nextafter(edge, 0), 1e-9, 1e9, float("nan"), float("inf"), None, -1.0]
    objects = {"scene_id": ["a"] * len(masses), "mass_kg": pa.array(masses, pa.float64())}
    found = compute_statistics(write_rows(tmp_path / "out", [{"objects": objects}])).masses_kg
    assert (found.counts[5], found.counts[4], found.below, found.above, found.missing) == (1, 1, 2, 1, 3)
    assert sum(found.counts) + found.below + found.above + found.missing == len(masses)


def test_the_judges_name_comes_first_and_case_and_spaces_do_not_count(tmp_path):
    objects = {
        "scene_id": list("abcde"),
        "label": ["Mug", "cup", "mug ", None, "plate"],
        "relabel_name": [None, "MUG", "", None, "  "],
    }
    found = compute_statistics(write_rows(tmp_path / "out", [{"objects": objects}])).labels
    assert found.top == (("mug", 3), ("plate", 1))


def test_hostile_names_are_counted_and_drawn(tmp_path):
    names = [name for k, name in enumerate(HOSTILE) for _ in range(k + 1)]
    scenes = {"scene_id": HOSTILE, "status": ["dropped"] * 7, "stage": HOSTILE, "reason": HOSTILE, "source": HOSTILE}
    tasks = {"scene_id": names, "relation": names, "accepted": [True] * len(names)}
    dataset = write_rows(tmp_path / "out", [{"scenes": scenes, "objects": {"label": names}, "tasks": tasks}])
    paths = write_statistics(dataset, tmp_path / "figures")
    content = json.loads(paths[0].read_text())
    assert content["labels"]["names"] == 6
    assert max(len(name) for name, _ in content["labels"]["top"]) == 200
    ElementTree.parse(paths[1])
    assert b"alert" not in paths[1].read_bytes(), "letters are drawn as outlines"
    for name in HOSTILE:
        assert sanitize_label(name).isprintable()
        assert len(sanitize_label(name)) <= 26


def test_nothing_at_all_is_an_overview_too(tmp_path):
    dataset = write_rows(tmp_path / "out", [])
    found = compute_statistics(dataset)
    assert found.scenes["entered"] == 0
    assert found.long_tail == ()
    paths = write_statistics(dataset, tmp_path / "figures")
    assert all(path.stat().st_size > 100 for path in paths)


def test_the_same_dataset_gives_the_same_bytes_and_stays_as_it_was(tmp_path):
    out = write_small_dataset(tmp_path / "out")
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    first = [p.read_bytes() for p in write_statistics(open_dataset(out), tmp_path / "a")]
    again = [p.read_bytes() for p in write_statistics(open_dataset(out), tmp_path / "a")]
    assert first == again
    assert {p: p.read_bytes() for p in out.rglob("*") if p.is_file()} == before
    with pytest.raises(InputError, match="within the dataset"):
        write_statistics(open_dataset(out), out / "figures")


def test_the_command_says_what_it_wrote(tmp_path):
    out = write_small_dataset(tmp_path / "out")
    answer = CliRunner().invoke(app, ["stats", str(out)])
    assert answer.exit_code == 0
    assert (tmp_path / "out-statistics" / "overview.png").read_bytes()[:4] == b"\x89PNG"
    printed = json.loads(CliRunner().invoke(app, ["stats", str(out), "--json"]).stdout)
    assert printed == json.loads((tmp_path / "out-statistics" / "statistics.json").read_text())


def test_many_shards_are_counted(tmp_path):
    rng = np.random.default_rng(0)
    names = np.array([f"thing {k}" for k in range(3_500)], dtype=object)
    rank = 1 / np.arange(1, len(names) + 1)
    shards = []
    for _ in range(3):
        n, m = 1_000, 9_500
        status = rng.choice(["done", "dropped"], n, p=[0.8, 0.2])
        scenes = {"scene_id": ["s"] * n, "status": status, "stage": ["export"] * n, "n_objects": rng.integers(3, 20, n)}
        labels = names[rng.choice(len(names), m, p=rank / rank.sum())]
        objects = {"scene_id": ["s"] * m, "label": labels, "mass_kg": rng.random(m)}
        shards.append({"scenes": scenes, "objects": objects})
    dataset = write_rows(tmp_path / "out", shards)
    found = compute_statistics(dataset)
    assert found.objects["total"] == found.labels.total == 28_500
    assert len(found.labels.top) == TOP
    assert len(found.long_tail) <= 200
    assert found.long_tail[0][1] == found.labels.top[0][1]
    assert draw_overview(found, (), "png").startswith(b"\x89PNG")
