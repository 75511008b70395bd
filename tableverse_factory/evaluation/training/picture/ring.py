"""Rendered views in a ring on the training device, made anew beside the training in an order that seeds determine."""

from collections import deque
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import count

from tableverse_factory.core.process_pool import parallel_stream
from tableverse_factory.evaluation.training.picture.builder import SceneTables
from tableverse_factory.evaluation.training.picture.columns import View
from tableverse_factory.evaluation.training.picture.exposure import Renderer, Views, develop_views
from tableverse_factory.evaluation.training.picture.scenes import SceneMaker
from tableverse_factory.models.local.device import import_torch

torch = import_torch()

PACK_SCENES, SCENE_VIEWS = 16, 4
AHEAD = 3  # packs that each process makes ahead


def make_packs(maker: SceneMaker, seed: int, skip: int = 0, jobs: int = 0) -> Iterator[SceneTables]:
    """Make packs in order without end, after the first `skip`; `jobs` processes do it, with 0 this one."""
    make = partial(maker.make_pack, seed, scenes=PACK_SCENES, views=SCENE_VIEWS)
    return parallel_stream(make, count(skip), jobs, "makes scenes", AHEAD)


class ViewRing:
    """The last `capacity` views of a stream of packs; `past` are the numbers of views of its packs so far."""

    def __init__(self, renderer: Renderer, capacity: int, size: tuple[int, int], seed: int, device: str) -> None:
        plain = (size[1], size[0])
        shapes = ((3, *plain), plain, plain, (3, *plain), plain, (View.WIDTH,))
        kinds = (torch.uint8, torch.float32, torch.uint8, torch.int8, torch.uint8, torch.float32)
        self._slots = Views(
            *(torch.zeros((capacity, *shape), dtype=k, device=device) for shape, k in zip(shapes, kinds, strict=True))
        )
        self._renderer, self._seed, self._device = renderer, seed, device
        self._packs: Iterator[SceneTables] = iter(())
        self.capacity, self.made, self.rendered = capacity, 0, 0
        self.past: deque[int] = deque()
        self.packs_done = 0

    def start(
        self, maker: SceneMaker, seed: int, jobs: int = 0, packs: int = 0, made: int = 0, past: Sequence[int] = ()
    ) -> None:
        """Go on after `packs` packs and `made` views: render those again that the ring held, as `past` says."""
        self.made, self.packs_done = made - sum(past), packs - len(past)
        self._packs = make_packs(maker, seed, self.packs_done, jobs)
        while self.packs_done < packs:
            self.render_pack()

    def render_pack(self) -> None:
        """Render the next pack into the ring."""
        pack = next(self._packs)
        generator = torch.Generator(device=self._device)
        generator.manual_seed(self._seed * 1_000_003 + self.packs_done)
        cameras = torch.tensor(pack.views, device=self._device)
        views = develop_views(self._renderer.render(pack), cameras, generator)
        slots = (self.made + torch.arange(len(views), device=self._device)) % self.capacity
        for name in Views.__slots__:
            getattr(self._slots, name)[slots] = getattr(views, name)
        self.made += len(views)
        self.rendered += len(pack.views)
        self.packs_done += 1
        self.past.append(len(views))
        while sum(self.past) - self.past[0] >= self.capacity:
            self.past.popleft()

    def draw(self, batch: int) -> Views:
        """Draw views at random from torch's generator."""
        which = torch.randint(min(self.made, self.capacity), (batch,), device=self._device)
        return self._slots.select(which)

    def get(self, slots: slice) -> Views:
        """Get views by their slots."""
        return self._slots.select(slots)
