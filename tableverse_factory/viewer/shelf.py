"""Opened scenes, shared by all browsers: each is read once, the last few are kept."""

import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from tableverse_factory.dataset import Dataset, Scene
from tableverse_factory.errors import InputError
from tableverse_factory.text import printable
from tableverse_factory.viewer.catalogue import Catalogue, Found
from tableverse_factory.viewer.opened import OpenedScene

KEPT = 4
"""Opened scenes are of some tens of megabytes."""

Row = Mapping[str, Any]


class Shelf:
    """What can be looked at: the scenes of a dataset, or one scene without."""

    def __init__(self, source: Dataset | Scene) -> None:
        """Reads the list of scenes.

        Args:
            source: A dataset, or a scene of `scene_file`.

        Raises:
            InputError: if the list does not read.
        """
        self._dataset = source if isinstance(source, Dataset) else None
        self._alone = source if isinstance(source, Scene) else None
        self._catalogue = Catalogue(source) if isinstance(source, Dataset) else None
        self._opened: OrderedDict[str, OpenedScene] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return 1 if self._catalogue is None else len(self._catalogue)

    @property
    def has_links(self) -> bool:
        """Whether scenes have addresses of their own."""
        return self._dataset is not None

    def first(self) -> str | None:
        """The scene to begin with; None where there is none."""
        return self._catalogue.first() if self._catalogue is not None else self._only.scene_id

    def search(self, text: str, status: str) -> Found:
        """As `Catalogue.search`; the one scene, where there is no dataset."""
        if self._catalogue is None:
            return Found([self._only.scene_id])
        return self._catalogue.search(text, status)

    def open(self, scene_id: str) -> OpenedScene:
        """The scene of this id.

        Raises:
            InputError: if there is none, it has no files, or they do not load.
        """
        with self._lock:
            if scene_id not in self._opened:
                self._opened[scene_id] = OpenedScene(self._scene(scene_id))
            self._opened.move_to_end(scene_id)
            while len(self._opened) > KEPT:
                self._opened.popitem(last=False)
            return self._opened[scene_id]

    def lost(self, scene_id: str) -> Row | None:
        """The row of a scene that has no files; None for all others."""
        rows = self._rows("scenes", scene_id)
        return rows[0] if rows and rows[0]["tar_offset"] is None else None

    def objects(self, opened: OpenedScene) -> Sequence[Row]:
        """Rows of its objects; from its own files where there is no dataset."""
        if self._dataset is not None:
            return self._rows("objects", opened.scene.scene_id)
        labels = {str(item["object_id"]): item.get("label") for item in opened.meta.get("objects", [])}
        return [
            {"object_id": figure.name, "label": labels.get(figure.name), "mass_kg": figure.mass_kg}
            for figure in opened.figures
        ]

    def tasks(self, opened: OpenedScene) -> Sequence[Row]:
        """Rows of its tasks."""
        return self._rows("tasks", opened.scene.scene_id)

    @property
    def _only(self) -> Scene:
        assert self._alone is not None  # noqa: S101 - without a dataset there is a scene
        return self._alone

    def _scene(self, scene_id: str) -> Scene:
        return self._dataset.scene(scene_id) if self._dataset is not None else self._only

    def _rows(self, table: str, scene_id: str) -> list[dict[str, Any]]:
        if self._dataset is None:
            return []
        try:
            found = self._dataset.table(table).to_table(filter=pc.field("scene_id") == scene_id)
        except (pa.ArrowException, OSError) as error:
            raise InputError(f"{self._dataset.path}/{table}: does not read: {printable(str(error), 300)}") from None
        rows: list[dict[str, Any]] = found.to_pylist()
        return rows
