"""What earlier stages of the scenes left, this run or another: where a scene begins, and goes on after a loss."""

from collections.abc import Iterable, Mapping

from schemas.codec import decode
from tableverse_factory.core.errors import BuildError
from workers.driver.in_flight import InFlightScene
from workers.driver.job_spec import BuildSpec
from workers.state.checkpoint_store import RECORDS, CheckpointRef, CheckpointStore, cost_record, record_names
from workers.state.ledger import WORK, Ledger


class CheckpointIndex:
    """The records of a build, as its driver uses them."""

    def __init__(self, work: BuildSpec, ledger: Ledger) -> None:
        """Reads nothing yet."""
        self._work, self._ledger = work, ledger
        self._records = CheckpointStore(work.records_dir)
        self._known: tuple[int, Mapping[str, CheckpointRef]] = (-1, {})

    def begin(self, rank: int) -> InFlightScene:
        """The scene of a row that was not rejected, behind its last stage that is kept.

        Raises:
            BuildError: see `resume`.
        """
        row = self._work.rows[rank]
        shard = self._ledger.shard_of(row.scene_id)
        if self._known[0] != shard:  # read when the shard's first scene enters: scenes come in the plan's order
            self._known = shard, self._records.index(shard)
        names = record_names(shard, row, self._work.fingerprints[row.kind])
        scene = InFlightScene(rank, row, self._work.lines[row.kind], names)
        scene.begin(self._known[1])
        self._enter(scene, self._known[1])
        return scene

    def resume(self, scenes: Iterable[InFlightScene], inputs_lost: bool) -> None:
        """Puts scenes behind their last stage that can still be read, if that is further or their inputs are lost.

        Raises:
            BuildError: if the disk refuses, or a scene that is whole in its shard would be computed from a picture that
                may not be there.
        """
        indexes: dict[int, Mapping[str, CheckpointRef]] = {}
        for scene in scenes:
            shard = self._ledger.shard_of(scene.row.scene_id)
            if shard not in indexes:
                indexes[shard] = self._records.index(shard)
            scene.resume(self._intact(scene, indexes[shard]), inputs_lost)
            self._enter(scene, indexes[shard])

    def before(self, scene: InFlightScene) -> bytes | None:
        """The input of the scene's stage, which is not its first; None where it is lost."""
        return self._records.read(scene.records[scene.position - 1])

    def forget(self, scene_id: str) -> None:
        """Removes the records of the scene's shard."""
        self._records.forget(self._ledger.shard_of(scene_id))

    def _enter(self, scene: InFlightScene, index: Mapping[str, CheckpointRef]) -> None:
        """Recalls what the questions of the stages behind it cost, as far as that was kept, and checks where it is."""
        for stage, name in zip(scene.line[: scene.position], scene.records, strict=False):
            located = index.get(cost_record(name))
            kept = None if located is None else self._records.read(located.place)
            if kept is not None:
                scene.costs[stage.name] = decode(kept)
        if self._work.added_only and not scene.stage.adds:
            raise BuildError(
                f"{scene.row.scene_id}: {scene.stage.name} would have to run again, because {RECORDS}/ was deleted or "
                "this scene was taken back before. Its files are still in its shard. Give the manifest, with "
                f"`tableverse build MANIFEST OUT --stages +{scene.line[-1].name}`, or delete {WORK}/, and add --again"
            )

    def _intact(self, scene: InFlightScene, index: Mapping[str, CheckpointRef]) -> dict[str, CheckpointRef]:
        """Those of its records that can still be read."""
        mine = {name: index[name] for name in scene.records if name in index}
        return {name: located for name, located in mine.items() if self._records.read(located.place) is not None}
