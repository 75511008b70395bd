"""Resume points of scenes: checkpoints that this run or an earlier one left."""

from collections.abc import Iterable, Mapping

from tableverse_factory.core.errors import BuildError
from tableverse_factory.dataset.journals import WORK
from workers.driver.in_flight import BuildSpec, InFlightScene
from workers.state.checkpoint_store import (
    CHECKPOINTS,
    CheckpointRef,
    CheckpointStore,
    name_checkpoints,
    name_cost_checkpoint,
)


class CheckpointIndex:
    """Checkpoints of a build, indexed by scene for its driver."""

    def __init__(self, spec: BuildSpec) -> None:
        self._spec = spec
        self._store = CheckpointStore(spec.records_dir)
        self._index: tuple[int, Mapping[str, CheckpointRef]] = (-1, {})

    def start(self, rank: int) -> InFlightScene:
        """Create the scene of a row behind its last stage with a checkpoint."""
        row, shard = self._spec.rows[rank], int(self._spec.shards[rank])
        if self._index[0] != shard:  # read when the shard's first scene enters: scenes come in the plan's order
            self._index = shard, self._store.index(shard)
        names = name_checkpoints(shard, row, self._spec.fingerprints[row.kind])
        scene = InFlightScene(rank, row, shard, self._spec.pipelines[row.kind], names)
        scene.start(self._index[1])
        self._restore_costs(scene, self._index[1])
        return scene

    def resume(self, scenes: Iterable[InFlightScene]) -> None:
        """Move scenes whose worker or input is lost behind their last readable checkpoint."""
        indexes: dict[int, Mapping[str, CheckpointRef]] = {}
        for scene in scenes:
            if scene.shard not in indexes:
                indexes[scene.shard] = self._store.index(scene.shard)
            scene.resume(self._find_readable(scene, indexes[scene.shard]))
            self._restore_costs(scene, indexes[scene.shard])

    def _restore_costs(self, scene: InFlightScene, index: Mapping[str, CheckpointRef]) -> None:
        """Restore the costs of finished stages and check that the scene may continue here."""
        for stage, name in zip(scene.stages[: scene.position], scene.records, strict=False):
            checkpoint = index.get(name_cost_checkpoint(name))
            cost = None if checkpoint is None else self._store.read(checkpoint.location)
            if cost is not None:
                scene.costs[stage.name] = cost.record
        if self._spec.added_only and not scene.stage.is_post_export:
            raise BuildError(
                f"{scene.row.scene_id}: {scene.stage.name} would have to run again, because {CHECKPOINTS}/ was deleted "
                "or this scene was taken back before. Its files are still in its shard. Give the manifest, with "
                f"`tableverse build MANIFEST OUT --stages +{scene.stages[-1].name}`, or delete {WORK}/, and add --again"
            )

    def _find_readable(self, scene: InFlightScene, index: Mapping[str, CheckpointRef]) -> dict[str, CheckpointRef]:
        found = {name: index[name] for name in scene.records if name in index}
        return {
            name: checkpoint for name, checkpoint in found.items() if self._store.read(checkpoint.location) is not None
        }
