"""A pipeline whose first two stages are models on a GPU, with random weights: true cost and shapes, no download."""

import os
from functools import cache
from pathlib import Path

from schemas.manifest import SceneKind
from schemas.outcome import Done
from tableverse_factory.evaluation.bench.noop_pipeline import make_minimal_scene
from tableverse_factory.stage import Stage

MARKS = "GPU_LINE_MARKS"


@cache
def _model(name: str):
    """One model per process, as a real stage would hold it."""
    import torch

    torch.manual_seed(len(name))
    if name == "segmenter":
        layers = [torch.nn.Conv2d(3 if i == 0 else 256, 256, 3, padding=1) for i in range(12)]
        return torch.nn.Sequential(*layers).half().cuda().eval()
    layer = torch.nn.TransformerEncoderLayer(1024, 16, 4096, batch_first=True)
    return torch.nn.TransformerEncoder(layer, 12).half().cuda().eval()


def _ask(name: str, shape: tuple[int, ...], rng) -> float:
    import torch

    with torch.inference_mode():
        x = torch.from_numpy(rng.standard_normal(shape, dtype="float32")).half().cuda()
        for _ in range(4):
            answer = _model(name)(x)
        return round(float(answer.float().mean()), 2)


def _note(stage: str) -> None:
    """Which GPU this process sees."""
    (Path(os.environ[MARKS]) / f"{stage}.{os.getpid()}").write_text(os.environ.get("CUDA_VISIBLE_DEVICES", ""))


def segment(row, config, rng, services):
    _note("perceive")
    return Done({"scene_id": row.scene_id, "mask": _ask("segmenter", (1, 3, 512, 512), rng)})


def complete(item, config, rng, services):
    _note("place")
    return Done({**item, "mesh": _ask("completer", (1, 1024, 1024), rng)})


def pack(item, config, rng, services):
    assert isinstance(item["mesh"], float)
    return Done(make_minimal_scene(item["scene_id"]))


STAGES = (
    Stage("perceive", "perception", segment, reads=("perceive",)),
    Stage("place", "geometry", complete, reads=("place",)),
    Stage("export", "physics", pack, reads=("export",)),
)
PIPELINES = dict.fromkeys(SceneKind, STAGES)
