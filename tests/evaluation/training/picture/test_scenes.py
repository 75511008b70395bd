"""Meshes and scenes of training: from a seed alone, and refused when damaged."""

from pathlib import Path

import numpy as np
import pytest

from tableverse_factory.core.errors import InputError
from tableverse_factory.evaluation.training.picture.builder import SceneTables
from tableverse_factory.evaluation.training.picture.materials import TextureBook
from tableverse_factory.evaluation.training.picture.patterns import BLOCKS, FACES, draw_block, make_textures
from tableverse_factory.evaluation.training.picture.pool import MeshPool, make_pool
from tableverse_factory.evaluation.training.picture.scenes import SceneMaker
from tableverse_factory.evaluation.training.picture.shapes import make_shapes
from tableverse_factory.evaluation.training.picture.tables import (
    LEAF,
    MAX_TRIANGLES,
    TABLE_SIDE,
    MeshTables,
    build_tree,
    make_tables,
)

SIZE = (96, 80)
BOOK = TextureBook(4, 12)


@pytest.fixture(scope="module")
def tables(pool: MeshPool) -> MeshTables:
    return make_tables(pool, 0)


def same(one: SceneTables, other: SceneTables) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in SceneTables.__slots__)


@pytest.mark.slow  # makes a pool three times
@pytest.mark.heavy
def test_a_pool_is_the_same_from_any_number_of_processes_and_comes_back_from_its_file(
    pool: MeshPool, pool_file: Path
) -> None:
    for other in (make_pool(2, seed=1, jobs=2), MeshPool.read(pool_file)):
        for name in MeshPool.__slots__:
            assert np.array_equal(getattr(pool, name), getattr(other, name)), name
    assert set(pool.scene) == {0, 1}
    assert (pool.poses[:, 2] > -0.2).all()


@pytest.mark.heavy
def test_a_damaged_pool_is_refused_in_one_line(pool_file: Path, tmp_path: Path) -> None:
    data, path = pool_file.read_bytes(), tmp_path / "meshes.npz"
    rng = np.random.default_rng(0)
    places = rng.integers(64, len(data) * 9 // 10, 12)  # within the arrays, which have checksums
    flipped = [data[:place] + bytes([data[place] ^ 0xFF]) + data[place + 1 :] for place in places]
    for damaged in (b"", b"no pool", data[: len(data) // 2], *flipped):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"^[^\n]*meshes\.npz is not a pool of meshes[^\n]*$"):
            MeshPool.read(path)
    with path.open("wb") as file:
        np.savez(file, vertices=np.zeros((1, 3)))
    with pytest.raises(InputError, match="not a pool of meshes"):
        MeshPool.read(path)


@pytest.mark.heavy
def test_a_pack_depends_on_seed_and_number_alone(tables: MeshTables) -> None:
    maker, _ = SceneMaker.hold_out(tables, BOOK, SIZE)
    packs = [maker.make_pack(*at, scenes=3, views=2) for at in ((0, 0), (0, 1), (1, 0), (0, 0))]
    assert same(packs[0], packs[3])
    assert not same(packs[0], packs[1])
    assert not same(packs[0], packs[2])


@pytest.mark.heavy
def test_rows_refer_to_rows_that_are_there(tables: MeshTables) -> None:
    maker, _ = SceneMaker.hold_out(tables, BOOK, SIZE)
    pack = maker.make_pack(0, 3, scenes=8, views=2)
    assert len(pack.scenes) == 8
    assert np.maximum(pack.scenes[:, 0], 1).sum() == len(pack.instances)
    assert np.isin(pack.instances[:, 18], tables.roots).all()
    assert pack.instances[:, 19].max() < len(pack.materials)
    assert pack.scenes[:, [8, 15, 16, 17, 18]].max() < len(pack.materials)
    assert (pack.materials[:, 0] + (FACES - 1) * pack.materials[:, 31] < BOOK.count).all()
    for row in pack.scenes:
        own = pack.instances[int(row[1]) : int(row[1] + row[0])]
        things = own[(own[:, 20] > 0) & (own[:, 20] < TABLE_SIDE)]
        assert (things[:, 14] > -0.05).all(), "a thing is sunk into the table"  # lowest corner of its box [m]
        assert row[20] + row[19] <= len(pack.lights)
    for view in pack.views:
        room = pack.scenes[int(view[16])]
        assert (view[:3] > room[9:12]).all()
        assert (view[:3] < room[12:15]).all()
        rotation = view[3:12].reshape(3, 3)
        assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
        assert np.linalg.det(rotation) > 0.99


@pytest.mark.heavy
def test_what_validates_is_never_trained_on(tables: MeshTables) -> None:
    training, validation = SceneMaker.hold_out(tables, BOOK, SIZE)
    assert not {*training.arrangements} & {*validation.arrangements}
    assert not {*training.pool} & {*validation.pool}
    assert sorted([*training.pool, *validation.pool]) == list(range(tables.kinds.count("pool")))
    assert len(training.tables.triangles) == 0, "processes that make scenes need none"


@pytest.mark.heavy
def test_the_tree_of_a_mesh_holds_each_triangle_once_within_its_boxes() -> None:
    for _, (vertices, faces) in list(make_shapes(0))[::9]:
        corners = vertices[faces]
        tree, order = build_tree(corners)
        assert sorted(order) == list(range(len(faces)))
        leaves = tree[tree[:, 7] > 0]
        assert leaves[:, 7].sum() == len(faces)
        assert leaves[:, 7].max() <= LEAF
        for leaf in leaves:
            own = corners[order[int(leaf[6]) : int(leaf[6] + leaf[7])]]
            assert (own >= leaf[:3]).all()
            assert (own <= leaf[3:6]).all()
        for node in tree[tree[:, 7] == 0]:
            children = tree[int(node[6]) : int(node[6]) + 2]
            assert (children[:, :3] >= node[:3]).all()
            assert (children[:, 3:6] <= node[3:6]).all()


@pytest.mark.heavy
def test_a_pool_of_more_triangles_than_a_float_counts_is_refused(
    pool: MeshPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert np.float32(MAX_TRIANGLES) + 1 == np.float32(MAX_TRIANGLES) != np.float32(MAX_TRIANGLES - 1)
    monkeypatch.setattr("tableverse_factory.evaluation.training.picture.tables.MAX_TRIANGLES", 1000)
    with pytest.raises(InputError, match="at most 1000: take fewer scenes"):
        make_tables(pool, 0)


def test_shapes_fit_their_box() -> None:
    for kind, (vertices, faces) in make_shapes(1):
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        assert (low >= [-0.5001, -0.5001, -1e-6]).all(), kind
        assert (high <= [0.5001, 0.5001, 1.0001]).all(), kind
        assert faces.min() >= 0, kind
        assert faces.max() < len(vertices), kind


@pytest.mark.heavy
def test_textures_are_drawn_from_a_seed_and_packages_come_first() -> None:
    printed, plain = draw_block(0, BLOCKS, 2 * BLOCKS, 7)
    assert (len(printed), len(plain)) == (FACES, 2)
    again = make_textures(7, 1, 2)
    assert np.array_equal(np.concatenate([printed, plain]), again)
    assert not np.array_equal(make_textures(8, 1, 2), again)
    counts = [tuple(map(len, draw_block(0, 5, 3, block))) for block in range(0, BLOCKS, 4)]
    assert all(a in (0, FACES) and b in (0, 1) for a, b in counts)
