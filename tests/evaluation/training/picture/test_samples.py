"""Samples: geometry survives augmentation, a sensor's model stays within bounds, targets lead to the middle."""

import itertools
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the extra `models` is not installed")
from tableverse_factory.evaluation.training.picture import samples as samples_module  # noqa: E402
from tableverse_factory.evaluation.training.picture.exposure import Views  # noqa: E402
from tableverse_factory.evaluation.training.picture.losses import compute_losses, find_targets  # noqa: E402
from tableverse_factory.evaluation.training.picture.network import PictureNetwork  # noqa: E402
from tableverse_factory.evaluation.training.picture.ring import ViewRing  # noqa: E402
from tableverse_factory.evaluation.training.picture.samples import Sample, make_sample  # noqa: E402
from tableverse_factory.evaluation.training.picture.sensor import (  # noqa: E402
    FARTHEST_M,
    NEAREST_M,
    sense_depth,
)
from tableverse_factory.models.picture.net import REACHES  # noqa: E402

SIZE = (96, 80)
NEAR = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]  # a pixel and its eight neighbours
pytestmark = pytest.mark.heavy


@pytest.fixture(scope="module")
def views(world: Any) -> Views:
    """Two packs, rendered on the CPU."""
    from tableverse_factory.evaluation.training.picture.render_cpu import CpuRenderer

    ring = ViewRing(CpuRenderer(world.tables, SIZE), 128, SIZE, 0, "cpu")
    ring.start(world.training, 0)
    while ring.made < 64:
        ring.render_pack()
    return ring.get(slice(0, 48))


@pytest.mark.parametrize("size", [pytest.param(None, marks=pytest.mark.slow), (80, 64), (96, 64)])
def test_what_is_table_stays_on_its_plane_however_it_is_cropped(views: Views, size: tuple[int, int] | None) -> None:
    torch.manual_seed(3)
    sample = make_sample(views, augment=True, size=size)
    width, height = size or SIZE
    assert sample.image.shape == (48, 3, height, width)
    tops = sample.tops & (sample.table[:, None, None] > 0)
    off = sample.height[tops].abs()
    assert off.median() < 0.003, "a pixel is drawn from its nearest neighbour"
    assert off.quantile(0.95) < 0.02
    assert sample.height[sample.things].median() > 0.01
    assert torch.allclose(sample.rays.norm(dim=1), torch.ones(()), atol=1e-5)
    shows = sample.table > 0
    assert torch.allclose(sample.plane[shows, :3].norm(dim=1), torch.ones(()), atol=1e-4)
    assert (sample.plane[shows, 3] > 0.05).all()


def test_without_augmentation_a_sample_is_the_view(views: Views) -> None:
    sample = make_sample(views, augment=False, depth_share=0.5)
    assert torch.equal((sample.image * 255).round().byte(), views.images)
    assert torch.equal(sample.ids, views.ids.long())
    assert torch.equal(sample.depth, views.depth)
    has_depth = sample.sensed.flatten(1).amax(1) > 0
    assert has_depth[:24].float().mean() > 0.8, "all but what is out of reach"
    assert not has_depth[24:].any()


def test_augmented_samples_are_pictures_some_with_depth_and_the_same_from_one_seed(views: Views) -> None:
    made = []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)
        made.append(make_sample(views, augment=True))
    for name in Sample.__slots__:
        assert torch.equal(getattr(made[0], name), getattr(made[1], name)), name
        assert torch.isfinite(getattr(made[0], name).float()).all(), name
    assert not torch.equal(made[0].image, made[2].image)
    assert made[0].image.min() >= 0
    assert made[0].image.max() <= 1
    has_depth = made[0].sensed.flatten(1).amax(1) > 0
    assert 0.15 < has_depth.float().mean() < 0.65


def test_a_sensor_leaves_holes_and_errs_within_bounds(views: Views) -> None:
    torch.manual_seed(0)
    sample = make_sample(views, augment=False, depth_share=1.0)
    true, sensed = sample.depth, sample.sensed[:, 0]
    within = (true > NEAREST_M) & (true < FARTHEST_M)
    assert (sensed[~within] == 0).all()
    seen = (sensed > 0) & within
    shares = seen.flatten(1).sum(1) / within.flatten(1).sum(1).clamp(min=1)
    assert 0.03 < 1 - shares[within.flatten(1).any(1)].mean() < 0.5
    error = (sensed - true).abs()[seen] / true[seen]
    assert 0 < error.median() < 0.01
    assert error.quantile(0.9) < 0.05


def test_noise_of_a_sensor_grows_with_the_square_of_the_distance() -> None:
    shape, errors = (24, 48, 64), []
    towards = torch.tensor([0.0, 0, 1])[None, :, None, None].expand(24, 3, 48, 64)
    for distance in (0.5, 1.0, 2.0):
        torch.manual_seed(0)
        wall, zero = torch.full(shape, distance), torch.zeros(shape)
        sensed = sense_depth(wall, -towards, zero, zero + 0.5, towards, torch.full((24,), 60.0))
        errors.append(float((sensed - wall)[sensed > 0].std()))
    assert np.allclose(np.array(errors[1:]) / errors[:-1], 4, rtol=0.2), errors


def test_faults_of_a_camera_that_do_nothing_change_nothing() -> None:
    image = torch.rand(2, 3, 32, 48, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(samples_module._compress(image, torch.full((2,), 1e-6)), image, atol=1e-4)
    assert torch.allclose(samples_module._blur(image, torch.zeros(2)), image, atol=1e-6)
    flat = torch.full((2, 3, 32, 48), 0.3)
    assert torch.allclose(samples_module._blur(flat, torch.full((2,), 1.5)), flat, atol=1e-6)
    coarse = samples_module._compress(image, torch.full((2,), 4.0))
    assert 0.01 < (coarse - image).abs().mean() < 0.5


def test_votes_lead_from_every_pixel_to_one_middle_of_its_thing(views: Views) -> None:
    sample = make_sample(views, augment=False)
    targets = find_targets(sample)
    ys, xs = torch.meshgrid(torch.arange(SIZE[1]), torch.arange(SIZE[0]), indexing="ij")
    for ids, votes, pixels, edge in zip(sample.ids, targets.votes, targets.pixels, targets.boundary, strict=True):
        things = (ids > 0) & (ids < 254)
        assert (votes[:, ~things] == 0).all()
        for thing in ids[things].unique():
            own = ids == thing
            assert (pixels[own] == own.sum()).all()
            middle = torch.stack([xs[own] + votes[0, own], ys[own] + votes[1, own]])
            assert torch.allclose(middle, middle[:, :1], atol=1e-3)
            assert torch.allclose(middle[:, 0], torch.stack([xs[own], ys[own]]).float().mean(1), atol=1e-3)
        own = torch.where(things, ids, 0)
        around = torch.stack([own[1 + dy : own.shape[0] - 1 + dy, 1 + dx : own.shape[1] - 1 + dx] for dy, dx in NEAR])
        assert torch.equal(edge[1:-1, 1:-1] == 1, (around != own[1:-1, 1:-1]).any(0))
        assert set(edge.unique().tolist()) <= {0.0, 1.0}


@pytest.mark.slow  # draws many views
def test_flat_pictures_take_the_place_of_some_samples_without_a_sensor(views: Views, world: Any) -> None:
    torch.manual_seed(0)
    flat = torch.zeros(3, 3, 32, 32, dtype=torch.uint8)
    many = views.select(torch.arange(48).repeat(8))
    sample = make_sample(many, augment=True, flat=flat)
    replaced = sample.solid == 0
    assert 0.02 < replaced.float().mean() < 0.12
    assert (sample.table[replaced] == 0).all()
    assert (sample.ids[replaced] == 0).all()
    assert (sample.sensed[replaced] == 0).all()
    assert sample.image[replaced].mean() < 0.15 < sample.image[~replaced].mean()
    shown = np.unique(world.flat.reshape(len(world.flat), -1), axis=0)
    assert len(shown) == len(world.flat) == 8, "each is another"


def answer(sample: Sample) -> list[Any]:
    """Outputs that say the truth."""
    targets = find_targets(sample)
    classes = torch.where(sample.things, 2, torch.where(sample.tops, 1, 0))
    label = 20 * torch.nn.functional.one_hot(classes, 3).permute(0, 3, 1, 2).float()
    log_depth = sample.depth.clamp(0.1, 8).log()[:, None]
    height = (sample.height / sample.depth.clamp(min=0.1))[:, None]
    center = torch.logit(torch.exp(-targets.votes.square().sum(1, keepdim=True) / 8) * sample.things[:, None], 1e-6)
    boundary = 40 * targets.boundary[:, None] - 20
    affinity = torch.zeros(*sample.image[:, :1].shape).repeat(1, 6, 1, 1)
    for index, (reach, axis) in enumerate(itertools.product(REACHES, (2, 1))):
        same = sample.ids == sample.ids.roll(-reach, axis)
        affinity[:, index] = 40 * same.float() - 20
    table = 40 * sample.table[:, None] - 20
    sigma = torch.full((len(table), 1), 0.1)
    return [label, log_depth, height, center, targets.votes, boundary, affinity, sample.plane, table, sigma]


def test_the_truth_costs_nothing_and_each_error_costs_in_its_own_term(views: Views) -> None:
    sample = make_sample(views.select(slice(0, 8)), augment=False)
    targets = find_targets(sample)
    best = compute_losses(answer(sample), sample, targets)
    exact = (
        "label",
        "depth",
        "shape",
        "steps",
        "height",
        "votes",
        "boundary",
        "affinity",
        "normal",
        "distance",
        "table",
    )
    for name in exact:
        assert best[name] < 1e-3, name
    shifted = {0: "label", 2: "height", 4: "votes", 5: "boundary", 6: "affinity", 8: "table"}
    for index, name in shifted.items():
        outputs = answer(sample)
        outputs[index] = outputs[index].roll(9, -1) if index != 8 else -outputs[index]
        worse = compute_losses(outputs, sample, targets)
        assert worse[name] > best[name] + 1e-2, name
        assert all(torch.equal(worse[other], best[other]) for other in best if other != name), name
    outputs = answer(sample)
    outputs[1] = outputs[1] + 0.3
    scaled = compute_losses(outputs, sample, targets)
    assert scaled["depth"] > 0.1
    assert scaled["shape"] < 1e-3, "shape is compared without scale"
    assert scaled["sigma"] > best["sigma"], "a stated deviation of a tenth does not cover it"


def test_without_a_sensor_depth_is_free_and_a_sensor_is_passed_on_where_it_is_trusted(thin: None) -> None:
    network = PictureNetwork().eval()
    ys, xs = torch.meshgrid(torch.linspace(-0.4, 0.4, 32), torch.linspace(-0.5, 0.5, 48), indexing="ij")
    rays = torch.nn.functional.normalize(torch.stack([xs, ys, torch.ones_like(xs)]), dim=0)[None]
    image, none = torch.rand(1, 3, 32, 48), torch.zeros(1, 1, 32, 48)
    depth = none + 0.7
    with torch.no_grad():
        network.dense.bias[4] = 50.0  # it trusts
        trusting = network(image, rays, depth)
        alone = network(image, rays, none)
        network.dense.bias[4] = -50.0
        doubting = network(image, rays, depth)
    assert torch.allclose(trusting[1].exp(), depth, atol=1e-4)
    assert not torch.allclose(doubting[1].exp(), depth, atol=1e-2)
    assert not torch.allclose(alone[1].exp(), depth, atol=1e-2)
    assert torch.allclose(trusting[7][:, :3].norm(dim=1), torch.ones(()))
    shapes = [tuple(each.shape[1:]) for each in trusting]
    assert shapes == [(c, 32, 48) for c in (3, 1, 1, 1, 2, 1, 6)] + [(4,), (1,), (1,)]
