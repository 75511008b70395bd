"""One scene of a dataset, in memory: its files, its rows, its model."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.trajectory import Trajectory

if TYPE_CHECKING:
    import mujoco

    from tableverse_factory.dataset.randomize import TableTexture


def _no_rows(_: str) -> list[dict[str, Any]]:
    """Of a scene that lies in no dataset."""
    return []


@dataclass(frozen=True, slots=True)
class Scene:
    """One exported scene.

    Attributes:
        row: Its row of scenes/.
    """

    scene_id: str
    row: Mapping[str, Any]
    _files: Mapping[str, bytes]
    _rows: Callable[[str], list[dict[str, Any]]] = _no_rows

    def files(self) -> dict[str, bytes]:
        """Every file by its name: `scene.xml`, `assets/…`, `meta.json`, `observation/…`, `trajectories/…`."""
        return dict(self._files)

    def trajectories(self) -> tuple[Trajectory, ...]:
        """How each of its tasks was tried, in their order; none where no trajectories were asked for.

        Raises:
            InputError: if the table of trajectories does not read, or names a file that is not there.
        """
        return tuple(
            Trajectory(row, None if row["arrays"] is None else self._file(row["arrays"]))
            for row in self.trajectory_rows()
        )

    def trajectory_rows(self) -> list[dict[str, Any]]:
        """Its rows of trajectories/, in the order of its tasks.

        Raises:
            InputError: if the table does not read.
        """
        return self._rows("trajectories")

    def object_rows(self) -> list[dict[str, Any]]:
        """Its rows of objects/; none where the scene lies in no dataset.

        Raises:
            InputError: if the table does not read.
        """
        return self._rows("objects")

    def task_rows(self) -> list[dict[str, Any]]:
        """Its rows of tasks/, also of the refused.

        Raises:
            InputError: if the table does not read.
        """
        return self._rows("tasks")

    def trajectory(self, task_id: str) -> Trajectory:
        """How this task was tried.

        Raises:
            InputError: if it was not, with the tasks that were.
        """
        found = {str(trajectory.row["task_id"]): trajectory for trajectory in self.trajectories()}
        if task_id not in found:
            tried = ", ".join(list(found)[:10]) or "none"
            raise InputError(
                f"scene {self.scene_id}: no trajectory of {sanitize_line(task_id, 80)!r}; tried were: {tried}"
            )
        return found[task_id]

    @property
    def xml(self) -> str:
        """The MJCF text."""
        return self._file("scene.xml").decode()

    @property
    def meta(self) -> dict[str, Any]:
        """`meta.json`: certificate, camera, poses and the judge's verdict (docs/formats.md).

        Raises:
            InputError: `bad_meta` if it is no JSON object, or its `objects` are no list of objects with ids.
        """
        from tableverse_factory.core.storage.untrusted import (
            parse_json,  # it brings Pillow, which queries need not load
        )

        meta = parse_json(self._file("meta.json"), f"scene {self.scene_id}: meta.json", "bad_meta")
        objects = meta.get("objects", []) if isinstance(meta, dict) else None
        if not isinstance(objects, list) or not all(isinstance(its, dict) and "object_id" in its for its in objects):
            raise InputError(f"scene {self.scene_id}: meta.json is not of a scene", "bad_meta")
        return dict(meta)

    def model(
        self, texture: "TableTexture | None" = None, lights: int | None = None, camera: int | None = None
    ) -> "mujoco.MjModel":
        """The compiled model, from memory; its looks as `restyled` changes them.

        Raises:
            InputError: if MuJoCo refuses it, or as `restyled`.
        """
        from tableverse_factory.physics.mjcf.load import load_model

        try:
            return load_model(self.restyle(texture, lights, camera)._files)
        except InputError as error:
            raise InputError(f"scene {self.scene_id}: {error}", error.reason) from None

    def restyle(
        self, texture: "TableTexture | None" = None, lights: int | None = None, camera: int | None = None
    ) -> "Scene":
        """The same scene in another light: bodies, masses and contacts stay as they are, and so does the dataset.

        Args:
            texture: What lies on the table: a seed or a name of `textures.catalogue`, or a picture of shape (h, w, 3)
                that covers `catalogue.TILE_M`; None keeps it.
            lights: Seed for place, strength and warmth of the lamps; None keeps them.
            camera: Seed for a small step aside of the camera `observation`; None keeps it.

        Raises:
            InputError: if there is no such texture, or the scene has no table to change.
        """
        if texture is None and lights is None and camera is None:
            return self
        from tableverse_factory.dataset.randomize import randomize_files

        files = randomize_files(self._files, texture, lights, camera)
        return Scene(self.scene_id, self.row, files, self._rows)

    def extract(self, dest: str | Path) -> tuple[Path, ...]:
        """Writes every file below the folder `dest` and returns the paths.

        Raises:
            InputError: if `dest` is not an empty or a new folder.
        """
        folder = Path(dest)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError(f"{folder}: already there; give a new or an empty folder")
        paths = []
        for name, data in self._files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
            paths.append(path)
        return tuple(paths)

    def _file(self, name: str) -> bytes:
        if name not in self._files:
            raise InputError(f"scene {self.scene_id} has no {name}")
        return self._files[name]
