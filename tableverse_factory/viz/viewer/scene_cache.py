"""Cache of loaded scenes, shared by all browsers."""

import threading
from collections import OrderedDict
from collections.abc import Mapping
from concurrent.futures import Future
from typing import Any

from tableverse_factory.dataset.dataset import Dataset, Scene
from tableverse_factory.viz.viewer.loaded_scene import LoadedScene
from tableverse_factory.viz.viewer.scene_index import SceneIndex, SearchHits

MAX_SCENES = 4  # most loaded scenes; each takes some tens of megabytes

Row = Mapping[str, Any]


class SceneCache:
    """The scenes of a dataset, or a single exported scene; the last few stay loaded."""

    def __init__(self, source: Dataset | Scene) -> None:
        """Read the list of scenes of a dataset, or take a scene of `load_scene_file`."""
        self.has_links = isinstance(source, Dataset)  # whether scenes have addresses of their own
        self._dataset = source if isinstance(source, Dataset) else None
        self._single = source if isinstance(source, Scene) else None
        self._index = SceneIndex(source) if isinstance(source, Dataset) else None
        self._loaded: OrderedDict[str, Future[LoadedScene]] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return 1 if self._index is None else len(self._index)

    def first(self) -> str | None:
        """Return the scene to begin with; None for an empty dataset."""
        return self._index.first() if self._index is not None else self._single_scene.scene_id

    def search(self, text: str, status: str) -> SearchHits:
        """Search as `SceneIndex.search`; a single scene always matches."""
        if self._index is None:
            return SearchHits([self._single_scene.scene_id])
        return self._index.search(text, status)

    def open(self, scene_id: str) -> LoadedScene:
        """Return a loaded scene; concurrent calls for one id wait for the same load."""
        with self._lock:
            future = self._loaded.get(scene_id)
            must_load = future is None
            if future is None:
                future = self._loaded[scene_id] = Future()
            self._loaded.move_to_end(scene_id)
            while len(self._loaded) > MAX_SCENES:
                self._loaded.popitem(last=False)
        if must_load:
            try:
                scene = self._dataset.scene(scene_id) if self._dataset is not None else self._single_scene
                future.set_result(LoadedScene(scene))
            except BaseException as error:  # noqa: BLE001 - it is passed on to all who wait
                with self._lock:
                    if self._loaded.get(scene_id) is future:
                        del self._loaded[scene_id]
                future.set_exception(error)
        return future.result()

    def find_dropped_row(self, scene_id: str) -> Row | None:
        """Return the row of a scene that was dropped or failed; None for all others."""
        if self._dataset is None or self._index is None or self._index.has_files(scene_id):
            return None
        return self._dataset.scene_row(scene_id)

    @property
    def _single_scene(self) -> Scene:
        assert self._single is not None  # noqa: S101 - without a dataset there is a scene
        return self._single
