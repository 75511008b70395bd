"""Methods on the same scenes, with the pictures of the real scenes."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from schemas.geometry import Picture
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.evaluation.methods.grid import CELL, read_reference, render_method, stitch_grid
from tableverse_factory.evaluation.methods.scenes import SceneSource
from tableverse_factory.evaluation.methods.sources import find_scenes
from tableverse_factory.evaluation.methods.vlm_vote import Question

PICTURES = (".png", ".jpg", ".jpeg", ".webp")
_CONTENT_HASH = re.compile(r"-[0-9a-f]{12}\Z")


class Comparison:
    """Methods with their scenes matched by name: `sources` by method, and `scenes`, the names that all methods have."""

    def __init__(
        self,
        sources: Mapping[str, Mapping[str, SceneSource]],
        paths: Mapping[str, Path],
        references: Path | None = None,
        side: int = CELL,
    ) -> None:
        self.sources = sources
        self.scenes = tuple(sorted(set.intersection(*(set(its) for its in sources.values()))))
        self._paths = paths
        self._references = references
        self._side = side
        self._drawn: tuple[str, dict[str, tuple[Picture, Picture]]] = ("", {})

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods in the given order."""
        return tuple(self.sources)

    @property
    def missing(self) -> dict[str, tuple[str, ...]]:
        """Scenes that another method has and this one lacks, by method."""
        everything = set().union(*self.sources.values())
        lacking = {method: tuple(sorted(everything - set(its))) for method, its in self.sources.items()}
        return {method: names for method, names in lacking.items() if names}

    def grid(self, question: Question) -> bytes:
        """Draw the grid of one question as a PNG file; a scene is drawn once for all its rounds."""
        scene = question.scene
        reference = read_reference(self.reference(scene), scene)
        if self._drawn[0] != scene:
            self._drawn = (
                scene,
                {method: render_method(its[scene].read(), self._side) for method, its in self.sources.items()},
            )
        return stitch_grid(reference, [self._drawn[1][method] for method in question.columns], self._side)

    def reference(self, scene: str) -> bytes:
        """Read the picture of the real scene; raise `no_reference` if there is none."""
        found = self._find_in_datasets(scene) if self._references is None else _find_reference(self._references, scene)
        if found is None:
            where = self._references or "the datasets that are compared; give --reference"
            raise InputError(f"{scene}: no picture of the real scene in {where}", "no_reference")
        return found

    def _find_in_datasets(self, scene: str) -> bytes | None:
        for method, its in self.sources.items():
            if its[scene].format == "dataset":
                files = open_dataset(self._paths[method]).scene(its[scene].name).files()
                if "observation/color.jpg" in files:
                    return files["observation/color.jpg"]
        return None


def match_methods(methods: Mapping[str, Path], references: Path | None = None, side: int = CELL) -> Comparison:
    """Match the scenes of methods by name.

    Args:
        methods: Path of each method.
        references: Folder of pictures of the real scenes, `<scene>.png` or `<scene>/color.png`; None for those in a
            dataset among the methods.
        side: Side of a cell of the grid [px].
    """
    sources = {method: index_by_shared_name(find_scenes(path)) for method, path in methods.items()}
    return Comparison(sources, dict(methods), references, side)


def check_shared_scenes(comparison: Comparison) -> None:
    """Raise `no_shared_scenes` unless the methods have a scene in common."""
    if not comparison.scenes:
        first = ", ".join(f"{min(its)} of {method}" for method, its in comparison.sources.items())
        raise InputError(
            f"no scene that every method has: scenes are matched by name, as {first}"[:500], "no_shared_scenes"
        )


def index_by_shared_name(sources: Sequence[SceneSource]) -> dict[str, SceneSource]:
    """Index scenes by the name shared with other methods: for ids of a dataset the part before the content hash."""
    short = [_CONTENT_HASH.sub("", source.name) if source.format == "dataset" else source.name for source in sources]
    return {
        name if short.count(name) == 1 else source.name: source for name, source in zip(short, sources, strict=True)
    }


def _find_reference(folder: Path, scene: str) -> bytes | None:
    names = [folder / f"{scene}{suffix}" for suffix in PICTURES]
    names += [folder / scene / f"color{suffix}" for suffix in PICTURES]
    return next((path.read_bytes() for path in names if path.is_file()), None)
