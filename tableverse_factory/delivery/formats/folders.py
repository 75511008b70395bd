"""Folders of scenes as the authors of the paper release theirs, and as `tableverse extract` writes them.

A folder per scene: an XML file with its assets, and scene.glb beside it.
"""

from pathlib import Path

SCENE_XML, SCENE_GLB = "scene.xml", "scene.glb"


def mjcf_file(folder: Path) -> Path | None:
    """The MJCF of a scene's folder: scene.xml, or the only XML where assets or scene.glb are beside it; else None."""
    if (folder / SCENE_XML).is_file():
        return folder / SCENE_XML
    documents = sorted(folder.glob("*.xml"))
    released = (folder / "assets").is_dir() or (folder / SCENE_GLB).is_file()
    return documents[0] if len(documents) == 1 and released else None


def scene_file(folder: Path) -> Path | None:
    """The file that is the scene: its MJCF, else scene.glb, else None."""
    glb = folder / SCENE_GLB
    return mjcf_file(folder) or (glb if glb.is_file() else None)


def scene_folders(folder: Path) -> list[tuple[str, Path]]:
    """Name and file of each scene whose folder lies in this one, sorted."""
    homes = sorted(entry for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith("."))
    found = ((home.name, scene_file(home)) for home in homes)
    return [(name, file) for name, file in found if file is not None]
