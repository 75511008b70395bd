"""Training of policies from packed demonstrations and pictures; it needs numpy, torch and safetensors alone."""

import copy
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tableverse_factory.core.errors import InputError, ModelError
from tableverse_factory.evaluation.training.checkpoint import (
    Trained,
    load_checkpoint,
    read_weights,
    save_checkpoint,
    write_weights,
)
from tableverse_factory.evaluation.training.differences import Inputs, hash_inputs
from tableverse_factory.evaluation.training.policy.demonstrations import Demonstrations
from tableverse_factory.evaluation.training.policy.lessons import Lesson, StateLesson
from tableverse_factory.evaluation.training.policy.network import make_network
from tableverse_factory.evaluation.training.policy.packed_pictures import PackedPictures
from tableverse_factory.evaluation.training.policy.picture_lesson import PictureLesson, PictureTensors
from tableverse_factory.evaluation.training.policy.settings import PolicyPosition, PolicySettings
from tableverse_factory.evaluation.training.policy.tensors import DemonstrationTensors
from tableverse_factory.evaluation.training.policy.validate import SEED
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()

WEIGHT_DECAY = 0.05
BETAS = (0.9, 0.98)
WARM_STEPS = 500
DECAY_FROM = 0.4  # share of the steps after which the rate falls linearly
MAX_NORM = 1.0
AVERAGE = 0.999  # of the weights that are kept
LOG_STEPS = 200
HARDLY_TRAINED = 0.1  # share of the steps below which the weights are of no use

Log = Callable[[str], object]


@dataclass(frozen=True, slots=True)
class TrainRun:
    """How a training is run; of it, only demonstrations and device change the weights.

    Attributes:
        folder: Of the checkpoint and of the weights.
        demonstrations: File of packed ones.
        device: `cpu` or `cuda`.
        minutes: After which to stop with a checkpoint.
        save_minutes: Between checkpoints.
        log_steps: Between lines of the log.
        graph: Record the kernels of a step once, on a GPU, and replay them: launching them one by one takes longer than
            computing. Each start then takes three steps more, unlogged.
    """

    folder: Path
    demonstrations: Path
    device: str = "cuda"
    minutes: float = math.inf
    save_minutes: float = 3.0
    log_steps: int = LOG_STEPS
    graph: bool = True


def train_state_policy(settings: PolicySettings, run: TrainRun, log: Log) -> int:
    """Train on states until all steps are done or the minutes are over; return the last step.

    A checkpoint in the folder is continued.
    """
    data = _load(settings, run)
    return _train(data, StateLesson(data), settings, run, log, hash_inputs({"demonstrations": run.demonstrations}))


def train_picture_policy(settings: PolicySettings, run: TrainRun, pictures: Path, state: Path, log: Log) -> int:
    """Train sight and goals on the pictures of the same demonstrations; `state` are the weights of a policy on states.

    Goals are trained on from its own; its motions are taken over as they are.
    """
    teacher = load_teacher(settings, state)
    data, packed = _load(settings, run), PackedPictures.read(pictures)
    lesson = PictureLesson(data, PictureTensors(packed, run.device), teacher)
    files = {"demonstrations": run.demonstrations, "pictures": pictures, "--pictures-from": state}
    return _train(data, lesson, settings, run, log, hash_inputs(files))


def load_teacher(settings: PolicySettings, state: Path) -> Any:
    """Load a policy on states to train one on pictures; InputError if it cannot be, or fewer motions are wanted."""
    if settings.scenes is not None or settings.motions is not None:  # sight learns from all views
        raise InputError("--scenes and --motions are for a policy on states: pack fewer datasets instead")
    teacher = make_network(0)
    read_weights(state, teacher)
    return teacher


def _load(settings: PolicySettings, run: TrainRun) -> DemonstrationTensors:
    own = Demonstrations.read(run.demonstrations)
    return DemonstrationTensors(own, run.device, settings.scenes, settings.motions)


def _train(
    data: DemonstrationTensors, lesson: Lesson, settings: PolicySettings, run: TrainRun, log: Log, inputs: Inputs
) -> int:
    try:
        return _Trainer(data, lesson, settings, run, log, inputs).train()
    except torch.OutOfMemoryError as error:
        raise InputError("the GPU's memory ran out: fewer goals or chunks per step need less") from error


class _Trainer:
    """Networks and optimizer of a training."""

    def __init__(
        self,
        data: DemonstrationTensors,
        lesson: Lesson,
        settings: PolicySettings,
        run: TrainRun,
        log: Log,
        inputs: Inputs,
    ) -> None:
        self._started, self._settings, self._run, self._log = time.monotonic(), settings, run, log
        self._data, self._lesson, self._inputs = data, lesson, inputs
        run.folder.mkdir(parents=True, exist_ok=True)
        self._network = lesson.make_network(settings.seed).to(run.device).train()
        self._average = copy.deepcopy(self._network).eval()
        self._optimizer = _make_optimizer(self._network, settings, run.device, lesson.rate_factors)
        self._trained = Trained(self._network, self._average, self._optimizer)
        position = load_checkpoint(run.folder, self._trained, settings, inputs, PolicyPosition(), run.device)
        self._step = position.step
        self._replay: tuple[Any, dict[str, Tensor]] | None = None
        counts = [len(data.choices[held_out][0]) for held_out in (False, True)]
        if not counts[0]:
            raise InputError(f"{run.demonstrations} holds no demonstrations to train on")
        self._say(f"{counts[0]} demonstrations, {counts[1]} held out, {settings.steps - self._step} steps are left")

    def _say(self, text: str) -> None:
        self._log(f"{time.monotonic() - self._started:7.1f} s  {text}")

    def train(self) -> int:
        """Take the steps that are left, or as many as the minutes allow, but one at least; return the last one."""
        settings, run, first = self._settings, self._run, self._step
        self._first_step_at = saved = time.monotonic()
        while self._step < settings.steps:
            self._step += 1
            losses = self._take_step(self._step)
            if self._step % run.log_steps == 0 or self._step == first + 1:
                self._log_step(losses, self._step - first)
            if time.monotonic() - self._started > 60 * run.minutes:
                break
            if time.monotonic() - saved > 60 * run.save_minutes and self._step < settings.steps:
                self._save()
                saved = time.monotonic()
        if self._step > first:
            step_s = self._measure_step(self._step - first)
            self._save()
            self._warn_if_hardly_trained(step_s)
        return self._step

    def _take_step(self, step: int) -> dict[str, Tensor]:
        torch.manual_seed(self._settings.seed * 100_000_007 + step)
        for group in self._optimizer.param_groups:
            group["lr"].fill_(group["factor"] * compute_rate(step, self._settings))
        if self._run.device != "cuda" or not self._run.graph:
            losses = self._descend()
        else:
            if self._replay is None:
                self._replay = self._record()
            self._replay[0].replay()
            losses = self._replay[1]
        self._average_weights(step)
        return losses

    def _descend(self) -> dict[str, Tensor]:
        """Compute losses and take a step down their gradient."""
        losses = self._lesson.compute_losses(self._network, self._settings)
        self._optimizer.zero_grad(set_to_none=True)
        torch.stack([*losses.values()]).sum().backward()
        for part in self._network.children():
            torch.nn.utils.clip_grad_norm_(part.parameters(), MAX_NORM)
        self._optimizer.step()
        return {name: each.detach() for name, each in losses.items()}

    def _record(self) -> tuple[Any, dict[str, Tensor]]:
        """Record the kernels of a step; return them, and where they leave the losses."""
        aside = torch.cuda.Stream()
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):
            for _ in range(3):
                self._descend()
        torch.cuda.current_stream().wait_stream(aside)
        graph = torch.cuda.CUDAGraph()
        self._optimizer.zero_grad(set_to_none=True)
        with torch.cuda.graph(graph):
            losses = self._descend()
        return graph, losses

    def _average_weights(self, step: int) -> None:
        keep = min(AVERAGE, (step + 1) / (step + 20))
        with torch.no_grad():
            torch._foreach_lerp_(list(self._average.parameters()), list(self._network.parameters()), 1 - keep)

    def _save(self) -> None:
        """Save, and measure the held-out demonstrations; weights that are not finite are refused."""
        if not all(torch.isfinite(each).all() for each in self._average.parameters()):
            raise ModelError(f"the weights of step {self._step} are not finite; the last checkpoint is kept")
        save_checkpoint(self._run.folder, self._trained, self._settings, self._inputs, [PolicyPosition(self._step)])
        write_weights(self._average, self._run.folder)
        for held_out in (False, True):
            if len(self._data.choices[held_out][0]):
                torch.manual_seed(SEED)
                figures = self._lesson.measure(self._average, held_out)
                kind = "held out" if held_out else "trained on"
                self._say(f"step {self._step} {kind}: {' '.join(f'{name} {v:.4g}' for name, v in figures.items())}")

    def _log_step(self, losses: dict[str, Tensor], done: int) -> None:
        parts = {name: float(each) for name, each in losses.items()}
        if not all(math.isfinite(each) for each in parts.values()):
            raise ModelError(f"the loss of step {self._step} is not finite: {parts}; the last checkpoint is kept")
        words = " ".join(f"{name} {each:.4f}" for name, each in parts.items())
        self._say(f"step {self._step}: {words}; {_format_pace(self._measure_step(done))}")

    def _measure_step(self, done: int) -> float:
        """Measure the time of a step, of so many that were taken in this run [s]."""
        return (time.monotonic() - self._first_step_at) / max(done, 1)

    def _warn_if_hardly_trained(self, step_s: float) -> None:
        """Warn where few of the steps were taken, and say how long all would take."""
        steps = self._settings.steps
        if self._step < HARDLY_TRAINED * steps:
            self._say(
                f"warning: {self._step} of {steps} steps, so the weights are hardly trained: at {_format_pace(step_s)} "
                f"all steps take {steps * step_s / 3600:.2g} h"
                + (" (a GPU is far faster)" if self._run.device == "cpu" else "")
            )


def _format_pace(step_s: float) -> str:
    return f"{1 / max(step_s, 1e-6):.1f} steps/s" if step_s < 1.0 else f"{step_s:.1f} s/step"


def compute_rate(step: int, settings: PolicySettings) -> float:
    """Compute the learning rate: linear warm-up, constant, linear decay to nothing."""
    warm = min(1.0, step / min(WARM_STEPS, max(1, settings.steps // 10)))
    left = 1 - (step - 1) / settings.steps
    return settings.rate * warm * min(1.0, left / (1 - DECAY_FROM))


def _make_optimizer(network: Any, settings: PolicySettings, device: str, rate_factors: Mapping[str, float]) -> Any:
    groups = [
        {
            "params": [p for p in part.parameters() if (p.ndim > 1) == decays],
            "weight_decay": WEIGHT_DECAY if decays else 0.0,
            "factor": rate_factors.get(name, 1.0),
            "lr": torch.tensor(settings.rate, device=device),
        }
        for decays in (True, False)  # outside, as checkpoints number moments in this order
        for name, part in network.named_children()
    ]
    on_gpu = device == "cuda"
    return torch.optim.AdamW(groups, betas=BETAS, fused=on_gpu, capturable=on_gpu)
