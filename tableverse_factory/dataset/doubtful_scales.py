"""Known lengths that a depth model contradicts, of which one is probably wrong."""

import pyarrow as pa
import pyarrow.compute as pc

DOUBTFUL_DEVIATION = 3.0  # standard deviations; of 27 photographs with a true length 25 lie within (docs/pictures.md)
SCALE_COLUMNS = ("scene_id", "status", "scale_deviation")


def is_scale_doubtful(deviation: float) -> bool:
    """Whether a `scale_deviation` is beyond `DOUBTFUL_DEVIATION`."""
    return abs(deviation) > DOUBTFUL_DEVIATION


def list_doubtful_scales(scenes: pa.Table) -> list[str]:
    """List the ids of finished scenes with a doubtful scale, from rows of scenes/ with `SCALE_COLUMNS`."""
    far = pc.greater(pc.abs(scenes["scale_deviation"]), DOUBTFUL_DEVIATION)
    ids: list[str] = scenes["scene_id"].filter(pc.and_(far, pc.equal(scenes["status"], "done"))).to_pylist()
    return ids
