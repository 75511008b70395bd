"""Labels of the path tracer, compiled for the CPU, against embree's."""

import ctypes
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tableverse_factory.evaluation.training.picture.tables import TABLE_SIDE, TABLE_TOP

torch = pytest.importorskip("torch", reason="the extra `models` is not installed")
from tableverse_factory.evaluation.training.picture import tables as tables_module  # noqa: E402
from tableverse_factory.evaluation.training.picture.exposure import Exposure, develop_views  # noqa: E402

COMPILER = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
SOURCE = Path(tables_module.__file__).with_name("tracer.cu")
WIDTH, HEIGHT = 96, 80

pytestmark = [pytest.mark.heavy, pytest.mark.skipif(COMPILER is None, reason="no C++ compiler is installed")]


@pytest.fixture(scope="module")
def tracer(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    library = tmp_path_factory.mktemp("tracer") / "libtracer.so"
    command = [COMPILER, "-x", "c++", "-std=c++17", "-O2", "-shared", "-fPIC", "-o", library, SOURCE]
    subprocess.run(command, check=True)
    return ctypes.CDLL(str(library))


def trace(tracer: ctypes.CDLL, world: Any, pack: Any, samples: int) -> Exposure:
    shape = (len(pack.views), HEIGHT, WIDTH)
    out = [np.zeros((*shape, 9), np.float32), np.zeros(shape, np.float32), np.zeros(shape, np.uint8)]
    out += [np.zeros((*shape, 3), np.int8), np.zeros(shape, np.uint8)]

    def address(array: np.ndarray) -> ctypes.c_void_p:
        assert array.flags.c_contiguous
        return ctypes.c_void_p(array.ctypes.data)

    meshes = world.tables.nodes, world.tables.triangles, world.tables.normals
    rows = pack.instances, pack.materials, pack.scenes, pack.lights, world.textures
    side = world.textures.shape[1]
    numbers = len(pack.views), WIDTH, HEIGHT, samples
    tracer.render(*map(address, (*meshes, *rows)), side, address(pack.views), *numbers, *map(address, out))
    return Exposure(*map(torch.from_numpy, out))


@pytest.fixture(scope="module")
def pack(world: Any) -> Any:
    return world.training.make_pack(0, 0, scenes=10, views=2)


@pytest.fixture(scope="module")
def traced(tracer: ctypes.CDLL, world: Any, pack: Any) -> Exposure:
    return trace(tracer, world, pack, 2)


@pytest.fixture(scope="module")
def cast(world: Any, pack: Any) -> Exposure:
    from tableverse_factory.evaluation.training.picture.render_cpu import CpuRenderer

    return CpuRenderer(world.tables, (WIDTH, HEIGHT)).render(pack)


@pytest.mark.slow  # draws views twice
def test_both_renderers_say_the_same_of_almost_every_pixel(traced: Exposure, cast: Exposure) -> None:
    assert {0, 1, 2, TABLE_TOP, TABLE_SIDE} <= {*np.unique(traced.ids)}
    same = traced.ids == cast.ids
    assert same.float().mean() > 0.9995
    apart = (traced.depth - cast.depth).abs() / cast.depth
    assert (apart[same] < 1e-3).float().mean() > 0.9995
    turned = (traced.normals.int() - cast.normals.int()).abs().amax(-1)
    assert (turned[same & (traced.ids == TABLE_TOP)] <= 1).all()
    assert (turned[same] <= 40).float().mean() > 0.995, "things are smooth for one and have faces for the other"
    assert ((traced.shine.int() - cast.shine.int()).abs()[same] <= 1).float().mean() > 0.9995


def test_the_table_is_at_height_zero(traced: Exposure, pack: Any) -> None:
    heights = []
    for depth, ids, view in zip(traced.depth, traced.ids, pack.views, strict=True):
        v, u = np.nonzero(ids.numpy() == TABLE_TOP)
        rays = np.stack([(u - view[14]) / view[12], (v - view[15]) / view[13], np.ones(len(u))])
        z = (view[3:12].reshape(3, 3) @ rays)[2] * depth[v, u].numpy() + view[2]
        heights.append(z)
    all_heights = np.concatenate(heights)
    assert len(all_heights) > 1000
    assert np.abs(all_heights).max() < 3e-3, "the table and the sheets that lie on it"
    assert np.median(np.abs(all_heights)) < 1e-4


@pytest.mark.slow  # traces many rays
def test_light_is_finite_the_same_again_and_its_mean_does_not_depend_on_the_number_of_rays(
    tracer: ctypes.CDLL, world: Any, pack: Any, traced: Exposure
) -> None:
    again = trace(tracer, world, pack, 2)
    assert torch.equal(again.light, traced.light)
    assert torch.isfinite(traced.light).all()
    assert (traced.light >= 0).all()
    more = trace(tracer, world, pack, 6)
    assert torch.equal(more.ids, traced.ids)
    assert torch.equal(more.depth, traced.depth)
    few, many = (each.light[..., :6].flatten(1).mean(1) for each in (traced, more))
    assert torch.allclose(few, many, rtol=0.1, atol=0.02)


def test_views_that_show_nothing_or_one_thing_too_near_are_dropped(traced: Exposure, pack: Any) -> None:
    cameras = torch.tensor(pack.views)
    views = develop_views(traced, cameras, torch.Generator().manual_seed(0))
    assert 0 < len(views) <= len(cameras)
    assert views.images.float().std() > 10
    near = Exposure(traced.light, torch.full_like(traced.depth, 0.05), traced.ids, traced.normals, traced.shine)
    assert len(develop_views(near, cameras, torch.Generator())) == 0
    full = Exposure(traced.light, traced.depth, torch.ones_like(traced.ids), traced.normals, traced.shine)
    kept = develop_views(full, cameras, torch.Generator())
    assert (kept.cameras[:, 18] == 0).all(), "only pictures of no table may show nothing but what is near"
