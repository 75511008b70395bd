"""The scene list of one browser: search, status, steps by scene and page."""

from tableverse_factory.viz.viewer.panel import BACK, NEXT, NO_MATCH, PAGE_BACK, PAGE_NEXT, Panel
from tableverse_factory.viz.viewer.panel_html import format_status
from tableverse_factory.viz.viewer.scene_cache import SceneCache

PAGE = 50  # scenes per page of the list

_STEPS = {PAGE_BACK: -PAGE, BACK: -1, NEXT: 1, PAGE_NEXT: PAGE}


class SceneList:
    """The scenes that match the search of one browser."""

    def __init__(self, panel: Panel, scenes: SceneCache) -> None:
        self._panel, self._scenes = panel, scenes
        self._hits = scenes.search("", panel.status.value)

    def search(self, current: str) -> str | None:
        """Search by the controls; return the scene to show instead, None if the shown one matches too, or none does."""
        self._hits = self._scenes.search(self._panel.search.value, self._panel.status.value)
        return self._hits.step_from(current, 0) if self._hits.position(current) < 0 else None

    def step(self, current: str) -> str | None:
        """Return the scene to which the pressed button leads; None if it leads nowhere."""
        other = self._hits.step_from(current, _STEPS.get(self._panel.step.value, 0))
        return other if other != current else None

    def show(self, current: str) -> None:
        """Offer the page of the current scene, and the scene itself even if it does not match."""
        panel, position = self._panel, self._hits.position(current)
        options = self._hits.page(current, PAGE) or [NO_MATCH]
        if position < 0 and current:
            options = [current, *options]
        panel.scene.options = options
        if current in options:
            panel.scene.value = current
        where = f"{position + 1:,} of " if position >= 0 else ""
        panel.place.content = format_status(f"{where}{len(self._hits):,} scenes found, {len(self._scenes):,} in all")
