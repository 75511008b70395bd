"""Training of the network of pictures on views that are rendered beside it."""

import copy
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tableverse_factory.core.errors import InputError, ModelError
from tableverse_factory.evaluation.training.checkpoint import (
    Trained,
    load_checkpoint,
    save_checkpoint,
    write_weights,
)
from tableverse_factory.evaluation.training.differences import hash_inputs
from tableverse_factory.evaluation.training.picture.exposure import Renderer, Views
from tableverse_factory.evaluation.training.picture.losses import compute_losses, find_targets
from tableverse_factory.evaluation.training.picture.network import make_network
from tableverse_factory.evaluation.training.picture.ranks import Ranks, start_ranks
from tableverse_factory.evaluation.training.picture.ring import ViewRing
from tableverse_factory.evaluation.training.picture.samples import Sample, make_sample
from tableverse_factory.evaluation.training.picture.settings import PictureSettings, TrainPosition
from tableverse_factory.evaluation.training.picture.start import measure_norms, read_start
from tableverse_factory.evaluation.training.picture.validate import validate_network
from tableverse_factory.evaluation.training.picture.world import World, make_world
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()

WEIGHT_DECAY = 0.05
BETAS = (0.9, 0.98)
WARM_STEPS = 400
DECAY_FROM = 0.6  # share of the steps after which the rate falls linearly
LEAST_RATE = 0.02
MAX_NORM = 2.0
AVERAGE = 0.999  # of the weights that are kept
LOG_STEPS = 100
NORM_BATCHES = 30  # that give the norms of an exported network their statistics
VALIDATION_VIEWS, VALIDATION_SEED, VALIDATION_BATCH = 256, 1_000_003, 32

Log = Callable[[str], object]


@dataclass(frozen=True, slots=True)
class TrainRun:
    """How a training is run; of it, only pool, start and device change the weights.

    Attributes:
        folder: Of the checkpoint and of the weights.
        pool: File of the meshes.
        device: `cpu` or `cuda`.
        jobs: Processes that make scenes; with 0 they are made between the steps.
        minutes: After which to stop with a checkpoint.
        save_minutes: Between checkpoints.
        validate: Whether to measure held-out views at every checkpoint.
        start: Weights to start from, as `write_weights` writes them, or an exported network; random ones without.
    """

    folder: Path
    pool: Path
    device: str = "cuda"
    jobs: int = 0
    minutes: float = math.inf
    save_minutes: float = 4.0
    validate: bool = True
    start: Path | None = None


def train_pictures(settings: PictureSettings, run: TrainRun, log: Log) -> int:
    """Train until all steps are done or the minutes are over; return the last step.

    A checkpoint in the folder is continued. With several `gpus` there is a process for each.
    """
    with start_ranks(settings.gpus, run.device, _train_rank, settings, run) as ranks:
        return _train_rank(settings, run, ranks, log)


def _train_rank(settings: PictureSettings, run: TrainRun, ranks: Ranks, log: Log = lambda _: None) -> int:
    if run.device == "cuda":  # the fastest kernels: only a CPU is held to the same weights
        torch.backends.cudnn.benchmark = True
        torch.backends.cudnn.deterministic = False
        torch.backends.cudnn.allow_tf32 = True
        torch.backends.cuda.matmul.allow_tf32 = True
    try:
        return _Trainer(settings, run, ranks, log).train()
    except torch.OutOfMemoryError as error:
        raise InputError("the GPU's memory ran out: a ring of fewer views, or smaller batches, need less") from error


class _Trainer:
    """Networks, optimizer and views of a training."""

    def __init__(self, settings: PictureSettings, run: TrainRun, ranks: Ranks, log: Log) -> None:
        self._started = time.monotonic()
        self._run, self._ranks, self._log = run, ranks, log
        network = make_network(settings.seed)
        lacks_statistics = False
        if run.start is not None:
            lacks_statistics = read_start(run.start, network)
        self._inputs = hash_inputs({"meshes": run.pool, "--from": run.start})
        self._settings = settings
        self._network = network.to(run.device, memory_format=torch.channels_last).train()
        self._average = copy.deepcopy(self._network).eval()
        self._optimizer = _make_optimizer(self._network, settings, run.device)
        self._trained = Trained(self._network, self._average, self._optimizer)
        position = load_checkpoint(
            run.folder, self._trained, settings, self._inputs, TrainPosition(), run.device, ranks.rank, settings.gpus
        )
        world = make_world(run.pool, settings, run.jobs)
        renderer = world.make_renderer(settings, run.device)
        self._say(f"{len(world.tables.roots)} meshes, {len(world.textures)} textures")
        self._flat = torch.from_numpy(world.flat).to(run.device).permute(0, 3, 1, 2).contiguous()
        self._seed = ranks.shift_seed(settings.seed)
        self._ring = ViewRing(renderer, settings.capacity, settings.size, self._seed, run.device)
        self._ring.start(world.training, self._seed, run.jobs, position.packs, position.made, position.past)
        self._held_out = self._render_held_out(world, renderer) if run.validate and not ranks.rank else []
        self._step = position.step
        if lacks_statistics and not self._step:
            self._measure_norms()
        self._mark = (self._step, self._ring.rendered, time.monotonic())  # since when rates are measured
        self._say(f"views are rendered, {settings.steps - self._step} steps are left")

    def _say(self, text: str) -> None:
        self._log(f"{time.monotonic() - self._started:7.1f} s  {text}")

    def _render_held_out(self, world: World, renderer: Renderer) -> list[Views]:
        """Render views of scenes and meshes that the training never sees."""
        settings = self._settings
        count = min(VALIDATION_VIEWS, settings.capacity)
        ring = ViewRing(renderer, count, settings.size, VALIDATION_SEED, self._run.device)
        ring.start(world.validation, VALIDATION_SEED + settings.seed)
        while ring.made < count:
            ring.render_pack()
        return [ring.get(slice(k, k + VALIDATION_BATCH)) for k in range(0, count, VALIDATION_BATCH)]

    def _render_fresh(self) -> None:
        """Render the views that are due before the next step."""
        due = self._settings.first + self._settings.fresh / self._settings.gpus * self._step
        while self._ring.made < due:
            self._ring.render_pack()

    def _measure_norms(self) -> None:
        self._render_fresh()
        measure_norms(self._network, (self._draw_sample(-k) for k in range(NORM_BATCHES)), self._run.device)
        self._ranks.average([*self._network.parameters(), *self._list_statistics()])
        self._average.load_state_dict(self._network.state_dict())

    def _list_statistics(self) -> list[Tensor]:
        return [buffer for buffer in self._network.buffers() if buffer.is_floating_point()]

    def train(self) -> int:
        """Take the steps that are left, or as many as the minutes allow, but one at least; return the last one."""
        settings, run, first, saved = self._settings, self._run, self._step, time.monotonic()
        while self._step < settings.steps:
            self._render_fresh()
            self._step += 1
            losses = self._take_step(self._step)
            if self._step % LOG_STEPS == 0 or self._step == first + 1:
                self._log_step(losses)
            now = time.monotonic()
            is_over, is_due = self._ranks.agree(
                now - self._started > 60 * run.minutes,
                now - saved > 60 * run.save_minutes and self._step < settings.steps,
            )
            if is_over:
                break
            if is_due:
                self._save()
                saved = time.monotonic()
        if self._step > first:
            self._save()
        return self._step

    def _draw_sample(self, step: int) -> Sample:
        settings = self._settings
        torch.manual_seed(self._seed * 100_000_007 + step)
        with torch.no_grad():
            views, size = self._ring.draw(settings.batch), settings.sample_size(step)
            return make_sample(views, augment=True, size=size, flat=self._flat)

    def _take_step(self, step: int) -> dict[str, Tensor]:
        device = self._run.device
        for group in self._optimizer.param_groups:
            group["lr"] = compute_rate(step, self._settings)
        sample = self._draw_sample(step)
        targets = find_targets(sample)
        image = sample.image.contiguous(memory_format=torch.channels_last)
        with torch.autocast(device, torch.bfloat16, enabled=device == "cuda"):
            outputs = self._network(image, sample.rays, sample.sensed)
        losses = compute_losses(outputs, sample, targets)
        self._optimizer.zero_grad(set_to_none=True)
        torch.stack([*losses.values()]).sum().backward()
        gradients = [each.grad for each in self._network.parameters()]
        self._ranks.average([*gradients, *self._list_statistics()])
        torch.nn.utils.clip_grad_norm_(self._network.parameters(), MAX_NORM)
        self._optimizer.step()
        self._average_weights(step)
        return losses

    def _average_weights(self, step: int) -> None:
        keep = min(AVERAGE, (step + 1) / (step + 20))
        with torch.no_grad():
            torch._foreach_lerp_(list(self._average.parameters()), list(self._network.parameters()), 1 - keep)
            torch._foreach_copy_(list(self._average.buffers()), list(self._network.buffers()))

    def _save(self) -> None:
        """Save, and measure the held-out views; weights that are not finite are refused."""
        ring, folder = self._ring, self._run.folder
        if not all(torch.isfinite(each).all() for each in self._average.parameters()):
            raise ModelError(f"the weights of step {self._step} are not finite; the last checkpoint is kept")
        position = TrainPosition(self._step, ring.packs_done, ring.made, tuple(ring.past))
        positions = self._ranks.gather(position)
        if self._ranks.rank:
            return
        save_checkpoint(folder, self._trained, self._settings, self._inputs, positions)
        write_weights(self._average, folder)
        for with_depth in (False, True) if self._held_out else ():
            figures = validate_network(self._average, self._held_out, self._run.device, with_depth)
            kind = "rgbd" if with_depth else "picture"
            self._say(f"step {self._step} {kind}: {' '.join(f'{name} {v:.4f}' for name, v in figures.items())}")
        self._mark = (self._step, ring.rendered, time.monotonic())

    def _log_step(self, losses: dict[str, Tensor]) -> None:
        parts = {name: float(each.detach()) for name, each in losses.items()}
        if not all(math.isfinite(each) for each in parts.values()):
            raise ModelError(f"the loss of step {self._step} is not finite: {parts}; the last checkpoint is kept")
        step, rendered, since = self._mark
        self._mark = (self._step, self._ring.rendered, time.monotonic())
        seconds = max(self._mark[2] - since, 1e-6)
        samples, views = (self._step - step) * self._settings.batch, self._ring.rendered - rendered
        self._say(
            f"step {self._step}: {' '.join(f'{name} {each:.3f}' for name, each in parts.items())}; "
            f"{samples / seconds:.0f} samples/s, {views / seconds:.0f} views/s"
        )


def compute_rate(step: int, settings: PictureSettings) -> float:
    """Compute the learning rate: linear warm-up, constant, linear decay."""
    warm = min(1.0, step / min(WARM_STEPS, max(1, settings.steps // 10)))
    along = step / settings.steps
    return settings.rate * warm * max(LEAST_RATE, min(1.0, (1 - along) / (1 - DECAY_FROM)))


def _make_optimizer(network: Any, settings: PictureSettings, device: str) -> Any:
    groups = [
        {"params": [p for p in network.parameters() if p.ndim > 1], "weight_decay": WEIGHT_DECAY},
        {"params": [p for p in network.parameters() if p.ndim <= 1], "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, lr=settings.rate, betas=BETAS, fused=device == "cuda")
