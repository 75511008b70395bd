"""Scene of a dataset in memory: its files, rows and model."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import describe_error, sanitize_line
from tableverse_factory.dataset.trajectory import Trajectory

if TYPE_CHECKING:
    import mujoco

    from tableverse_factory.dataset.randomize import TableTexture


@dataclass(frozen=True, slots=True)
class Scene:
    """Exported scene; methods raise InputError where its files or tables cannot be read."""

    scene_id: str
    row: Mapping[str, Any]
    _files: Mapping[str, bytes] = field(repr=False)
    _rows: Callable[[str], list[dict[str, Any]]] = field(default=lambda _table: [], repr=False)

    def files(self) -> dict[str, bytes]:
        """Return every file by name: `scene.xml`, `assets/…`, `meta.json`, `observation/…`, `trajectories/…`."""
        return dict(self._files)

    def trajectories(self) -> tuple[Trajectory, ...]:
        """Return the trajectory of each task that was tried, in the order of the tasks."""
        return tuple(
            Trajectory(row, None if row["arrays"] is None else self._read_file(row["arrays"]))
            for row in self.trajectory_rows()
        )

    def trajectory_rows(self) -> list[dict[str, Any]]:
        """Read its rows of trajectories/."""
        return self._rows("trajectories")

    def object_rows(self) -> list[dict[str, Any]]:
        """Read its rows of objects/."""
        return self._rows("objects")

    def task_rows(self) -> list[dict[str, Any]]:
        """Read its rows of tasks/, including refused ones."""
        return self._rows("tasks")

    def trajectory(self, task_id: str) -> Trajectory:
        """Return the trajectory of a task."""
        found = {str(trajectory.row["task_id"]): trajectory for trajectory in self.trajectories()}
        if task_id not in found:
            tried, asked = ", ".join(list(found)[:10]) or "none", sanitize_line(task_id, 80)
            raise InputError(f"scene {self.scene_id}: no trajectory of {asked!r}; tried were: {tried}")
        return found[task_id]

    @property
    def xml(self) -> str:
        """MJCF text."""
        try:
            return self._read_file("scene.xml").decode()
        except UnicodeDecodeError as error:
            problem = f"scene {self.scene_id}: scene.xml is not UTF-8: {describe_error(error)}"
            raise InputError(problem) from error

    @property
    def meta(self) -> dict[str, Any]:
        """Content of `meta.json`: certificate, camera, poses and the judge's verdict (docs/formats.md)."""
        from tableverse_factory.core.storage.untrusted import parse_json  # imports Pillow, which queries need not load

        meta = parse_json(self._read_file("meta.json"), f"scene {self.scene_id}: meta.json", "bad_meta")
        objects = meta.get("objects", []) if isinstance(meta, dict) else None
        if not isinstance(objects, list) or not all(isinstance(its, dict) and "object_id" in its for its in objects):
            raise InputError(f"scene {self.scene_id}: meta.json is not of a scene", "bad_meta")
        return dict(meta)

    def model(
        self, texture: "TableTexture | None" = None, lights: int | None = None, camera: int | None = None
    ) -> "mujoco.MjModel":
        """Compile the MuJoCo model from memory, with the appearance that `restyle` gives."""
        from tableverse_factory.physics.mjcf.load import load_model

        try:
            return load_model(self.restyle(texture, lights, camera)._files)
        except InputError as error:
            raise InputError(f"scene {self.scene_id}: {error}", error.reason) from None

    def restyle(
        self, texture: "TableTexture | None" = None, lights: int | None = None, camera: int | None = None
    ) -> "Scene":
        """Change the appearance: bodies, masses and contacts stay, and so does the dataset.

        Args:
            texture: Of the table: a seed or a name of `textures.catalogue`, or a picture of shape (h, w, 3)
                that covers `catalogue.TILE_M`; None keeps it.
            lights: Seed for position, strength and color temperature of the lamps; None keeps them.
            camera: Seed for a small displacement of the camera `observation`; None keeps it.
        """
        if texture is None and lights is None and camera is None:
            return self
        from tableverse_factory.dataset.randomize import randomize_files

        files = randomize_files(self._files, texture, lights, camera)
        return Scene(self.scene_id, self.row, files, self._rows)

    def extract(self, dest: str | Path) -> tuple[Path, ...]:
        """Write every file below the folder `dest` and return the paths."""
        folder = Path(dest)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError(f"{folder}: already there; give a new or an empty folder")
        for name, data in self._files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)
        return tuple(folder / name for name in self._files)

    def _read_file(self, name: str) -> bytes:
        if name not in self._files:
            raise InputError(f"scene {self.scene_id} has no {name}")
        return self._files[name]
