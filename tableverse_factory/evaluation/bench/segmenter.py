"""How many pictures a second become masks: from files to files, the plain loop beside what makes it fast."""

import collections
import itertools
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from schemas.config import ModelsConfig
from schemas.geometry import IdImage
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.png import png_bytes
from tableverse_factory.evaluation.bench.gpu import watched
from tableverse_factory.evaluation.bench.sam_random import random_sam2
from tableverse_factory.models.local.device import Device, device_of
from tableverse_factory.models.local.weights import release
from tableverse_factory.stages.perceive.sam.masks import BoxQuestion
from tableverse_factory.stages.perceive.sam.model import Sam, load

BOXES = 10
ENDINGS = (".jpg", ".jpeg", ".png")
AHEAD = 3
"""Batches that are read, computed or written at once, each."""
THREADS = 8


@dataclass(frozen=True, slots=True)
class SegmenterSetting:
    """One way to do the same work.

    Attributes:
        name: For the table.
        precision: Of the model.
        batch: Pictures in one forward.
        pipelined: Whether files are read and written while the model runs.
    """

    name: str
    precision: str
    batch: int
    pipelined: bool = False


@dataclass(frozen=True, slots=True)
class Rate:
    """What was measured of it.

    Attributes:
        per_s: Pictures per second.
        busy: Share of the time in which the GPU ran a kernel; None without one.
        peak_bytes: Most memory of the GPU that torch held; None without one.
    """

    setting: SegmenterSetting
    per_s: float
    busy: float | None
    peak_bytes: int | None


def settings_for(batches: Sequence[int]) -> tuple[SegmenterSetting, ...]:
    """The plain loop first, then half precision, then each batch size, plain and pipelined."""
    return (
        SegmenterSetting("plain loop", "float32", 1),
        SegmenterSetting("half precision", "bfloat16", 1),
        *(SegmenterSetting(f"batches of {size}", "bfloat16", size) for size in batches),
        *(SegmenterSetting(f"batches of {size}, pipelined", "bfloat16", size, pipelined=True) for size in batches),
    )


def bench_segmenter(
    folder: Path, out: Path, weights: str, size: str, config: ModelsConfig, batches: Sequence[int], count: int
) -> Iterator[Rate]:
    """Measures every setting on the same pictures, after a warm-up with each.

    Args:
        folder: Of pictures, at any depth; taken again from the first where there are too few.
        out: Where the id images go, one PNG for each picture.
        weights: `random`, a folder, or `owner/name` or `owner/name@revision` on the hub.
        size: Of the random model: `large` or `tiny`.
        config: Which device; its precision does not count.
        batches: Pictures in one forward, of each setting with batches.
        count: Pictures per setting.

    Raises:
        InputError: if there is no picture.
        ModelAccessError: without torch, the weights, or the GPU that is asked for.
    """
    files = sorted(p for p in folder.rglob("*") if p.suffix.lower() in ENDINGS and p.is_file())
    if not files:
        raise InputError(f"{folder} holds no picture ({', '.join(ENDINGS)})", "no_pictures")
    kind = device_of(config, "--device").kind
    for precision, group in itertools.groupby(settings_for(batches), key=lambda setting: setting.precision):
        device = Device(kind, "float32" if precision == "float32" else "bfloat16")
        model = random_sam2(size, device) if weights == "random" else load("sam2", weights, device)
        for setting in group:
            yield _measured(model, device, setting, list(itertools.islice(itertools.cycle(files), count)), out)
        del model
        release()


def _measured(model: Sam, device: Device, setting: SegmenterSetting, files: Sequence[Path], out: Path) -> Rate:
    run = _pipelined if setting.pipelined else _in_turn
    run(model, setting.batch, files[: 2 * setting.batch], out)
    with watched(device) as seen:
        started = time.perf_counter()
        run(model, setting.batch, files, out)
        took_s = time.perf_counter() - started
    return Rate(setting, len(files) / took_s, seen.busy, seen.peak_bytes)


def _in_turn(model: Sam, batch: int, files: Sequence[Path], out: Path) -> None:
    for start in range(0, len(files), batch):
        questions = [_read(start + k, path) for k, path in enumerate(files[start : start + batch])]
        for k, ids in enumerate(model.ids(questions, batch)):
            _write(out, start + k, ids)


def _pipelined(model: Sam, batch: int, files: Sequence[Path], out: Path) -> None:
    """Threads read ahead and write behind; the model's own work is begun as soon as its pictures are there."""
    with ThreadPoolExecutor(THREADS) as readers, ThreadPoolExecutor(THREADS) as writers:
        reading = _ahead(readers, files, AHEAD * batch)
        written: list[list[Future[None]]] = []
        for start in range(0, len(files), batch):
            pending = model.begin(list(itertools.islice(reading, batch)), batch)
            written.append(
                [writers.submit(lambda n, p: _write(out, n, p.result()), start + k, p) for k, p in enumerate(pending)]
            )
            for future in written.pop(0) if len(written) >= AHEAD else ():
                future.result()
        for future in itertools.chain(*written):
            future.result()


def _ahead(pool: ThreadPoolExecutor, files: Sequence[Path], most: int) -> Iterator[BoxQuestion]:
    """The pictures in order, at most so many of them begun before they are asked for."""
    begun = collections.deque(pool.submit(_read, k, path) for k, path in enumerate(files[:most]))
    for k in range(most, len(files) + most):
        if k < len(files):
            begun.append(pool.submit(_read, k, files[k]))
        yield begun.popleft().result()


def _read(number: int, path: Path) -> BoxQuestion:
    """A picture with boxes of the sizes that things on a table have.

    Raises:
        InputError: if it is no picture.
    """
    try:
        with Image.open(path) as opened:
            color = np.asarray(opened.convert("RGB"))
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise InputError(f"{path} cannot be read as a picture: {error}", "bad_picture") from error
    height, width = color.shape[:2]
    rng = np.random.default_rng(number)
    corner = rng.uniform(0.0, 0.8, (BOXES, 2))
    size = rng.uniform(0.05, 0.2, (BOXES, 2))
    boxes = np.hstack([corner, corner + size]) * [width, height, width, height]
    return BoxQuestion(color, boxes, np.full(BOXES, -1, dtype=np.int64))


def _write(out: Path, number: int, ids: IdImage) -> None:
    (out / f"{number:06d}.png").write_bytes(png_bytes(ids.clip(0).astype(np.uint8)))
