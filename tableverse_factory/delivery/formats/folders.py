"""Scene folders, as the paper's authors and `tableverse extract` write them: an XML file with assets, and scene.glb."""

from pathlib import Path

from schemas.identity import check_id
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line

SCENE_XML, SCENE_GLB = "scene.xml", "scene.glb"


def find_mjcf(folder: Path) -> Path | None:
    """Find the MJCF of a scene's folder: scene.xml, or the only XML beside assets or scene.glb; else None."""
    if (folder / SCENE_XML).is_file():
        return folder / SCENE_XML
    documents = sorted(folder.glob("*.xml"))
    released = (folder / "assets").is_dir() or (folder / SCENE_GLB).is_file()
    return documents[0] if len(documents) == 1 and released else None


def find_scene_file(folder: Path) -> Path | None:
    """Find a folder's scene file: its MJCF, else scene.glb, else None."""
    glb = folder / SCENE_GLB
    return find_mjcf(folder) or (glb if glb.is_file() else None)


def list_scene_folders(folder: Path) -> list[tuple[str, Path]]:
    """List name and file of each scene in subfolders, sorted."""
    homes = sorted(entry for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith("."))
    found = ((home.name, find_scene_file(home)) for home in homes)
    return [(name, file) for name, file in found if file is not None]


def check_body_name(name: str) -> None:
    """Check that a body, of a scene that may be foreign, can be a file; InputError `bad_name` if not."""
    try:
        check_id(name)
    except ValueError as error:
        why = sanitize_line(str(error), 200)
        raise InputError(f"a body of the scene cannot be a file: {why}", "bad_name") from None
