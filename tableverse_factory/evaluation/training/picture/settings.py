"""Settings of a training of pictures, and how far it has come."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PictureSettings:
    """Settings that determine the weights, with the meshes of the pool and the device.

    Attributes:
        steps: Of `batch` views per process; a continued training may change them, and with them its schedule.
        scenes: Arrangements in the pool of meshes.
        capacity: Views that are kept to draw from.
        first: Views that are rendered before the first step.
        fresh: New views that are rendered per step, by all processes together.
        small: Share of the steps, the first ones, whose samples have five sixths of the views' width and height.
        samples: Rays per pixel.
        packages, patterns: Textures, of which a package has three.
        flat: Flat pictures that show no table.
        rate: Peak of the learning rate.
        gpus: Processes, a GPU each, that average their gradients.
    """

    steps: int
    scenes: int = 1200
    seed: int = 0
    batch: int = 64
    width: int = 384
    height: int = 288
    capacity: int = 24_000
    first: int = 2_000
    fresh: float = 24.0
    small: float = 0.6
    samples: int = 12
    packages: int = 1_200
    patterns: int = 2_500
    flat: int = 2_400
    rate: float = 1.2e-3
    gpus: int = 1

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of a view [px]."""
        return self.width, self.height

    def sample_size(self, step: int) -> tuple[int, int]:
        """Width and height of the samples of a step [px], multiples of the network's 16."""
        if step > self.small * self.steps:
            return self.size
        return max(16, self.width * 5 // 96 * 16), max(16, self.height * 5 // 96 * 16)


@dataclass(frozen=True, slots=True)
class TrainPosition:
    """How far a process has come: steps, packs, views, and the numbers of views of the packs in its ring."""

    step: int = 0
    packs: int = 0
    made: int = 0
    past: tuple[int, ...] = ()
