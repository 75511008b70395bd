"""Opened scenes, shared by all browsers: each is read once, the last few are kept."""

import threading
from collections import OrderedDict
from collections.abc import Mapping
from concurrent.futures import Future
from typing import Any

from tableverse_factory.dataset.dataset import Dataset, Scene
from tableverse_factory.viz.viewer.catalogue import Catalogue, SearchHits
from tableverse_factory.viz.viewer.loaded_scene import OpenedScene

KEPT = 4
"""Opened scenes are of some tens of megabytes."""

Row = Mapping[str, Any]


class SceneCache:
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
        self._opened: OrderedDict[str, Future[OpenedScene]] = OrderedDict()
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

    def search(self, text: str, status: str) -> SearchHits:
        """As `Catalogue.search`; the one scene, where there is no dataset."""
        if self._catalogue is None:
            return SearchHits([self._only.scene_id])
        return self._catalogue.search(text, status)

    def open(self, scene_id: str) -> OpenedScene:
        """The scene of this id. Who asks for one that is just read waits for it, and nobody else does.

        Raises:
            InputError: if there is none, it has no files, or they do not load.
        """
        with self._lock:
            coming = self._opened.get(scene_id)
            mine = coming is None
            if coming is None:
                coming = self._opened[scene_id] = Future()
            self._opened.move_to_end(scene_id)
            while len(self._opened) > KEPT:
                self._opened.popitem(last=False)
        if mine:
            try:
                coming.set_result(OpenedScene(self._scene(scene_id)))
            except BaseException as error:  # noqa: BLE001 - those who wait must hear of it, whatever it is
                with self._lock:
                    if self._opened.get(scene_id) is coming:
                        del self._opened[scene_id]
                coming.set_exception(error)
        return coming.result()

    def lost(self, scene_id: str) -> Row | None:
        """The row of a scene that has no files; None for all others.

        Raises:
            InputError: if the row does not read.
        """
        if self._dataset is None or self._catalogue is None or self._catalogue.has_files(scene_id):
            return None
        return self._dataset.scene_row(scene_id)

    @property
    def _only(self) -> Scene:
        assert self._alone is not None  # noqa: S101 - without a dataset there is a scene
        return self._alone

    def _scene(self, scene_id: str) -> Scene:
        return self._dataset.scene(scene_id) if self._dataset is not None else self._only
