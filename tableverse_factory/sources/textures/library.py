"""Library of indexed textures: sets by seed or name, and their colour maps."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from PIL import Image

from schemas.geometry import Picture
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.core.storage.parquet import encode_parquet
from tableverse_factory.core.storage.untrusted import LARGE_IMAGE_BOUNDS, decode_image, open_image, read_bytes
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.sources.textures.repository import INDEX_SCHEMA

DEFAULT_PX = 1024


def write_index(path: Path, table: pa.Table) -> None:
    """Write the table of `index_textures`."""
    write_atomic(path, encode_parquet(table))


class TextureLibrary:
    """The usable sets of an index, in its order; their paths start from `root`."""

    def __init__(self, table: pa.Table, root: Path) -> None:
        self.table = table
        self.root = root

    def __len__(self) -> int:
        return int(self.table.num_rows)

    def get_row(self, which: int | str) -> dict[str, Any]:
        """Get the row of a seed (modulo the number of sets), of a texture_id, or of the first set of a name."""
        if not len(self):
            raise InputError("the index holds no usable texture")
        if isinstance(which, int):
            index = which % len(self)
        else:
            same = pc.or_(pc.equal(self.table["texture_id"], which), pc.equal(self.table["name"], which))
            index = pc.index(same, True).as_py()
            if index < 0:
                raise InputError(
                    f"no texture {sanitize_line(which, 60)!r} among the {len(self)} usable ones of the index"
                )
        return self.table.slice(index, 1).to_pylist()[0]

    def read_picture(self, which: int | str, most_px: int = DEFAULT_PX) -> Picture:
        """Read the colour map, its longer side reduced to `most_px`, for `Scene.model(texture=…)`."""
        file = str(self.get_row(which)["color"])
        path = (self.root / file).resolve()
        if not path.is_relative_to(self.root.resolve()):
            raise InputError(f"{sanitize_line(file)} lies outside {sanitize_line(str(self.root))}", "unreadable_map")
        data = read_bytes(str(path), LARGE_IMAGE_BOUNDS.max_file_bytes, "unreadable_map")
        image = open_image(data, file, LARGE_IMAGE_BOUNDS, "unreadable_map")
        picture = decode_image(image, file, "RGB", "unreadable_map")
        share = most_px / max(picture.shape[:2])
        if share < 1.0:
            size = tuple(max(1, round(side * share)) for side in picture.shape[1::-1])
            picture = np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BOX))
        return picture


def open_library(path: Path, root: Path | None = None) -> TextureLibrary:
    """Open an index that `tableverse textures index` wrote; `root` replaces the folder at the time of indexing."""
    try:
        table = pq.read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise InputError(f"{sanitize_line(str(path))}: does not read: {sanitize_line(str(error), 300)}") from None
    metadata = table.schema.metadata or {}
    if not table.schema.equals(INDEX_SCHEMA) or b"root" not in metadata:
        raise InputError(f"{sanitize_line(str(path))}: no index of textures; make one with `tableverse textures index`")
    usable = table.filter(pc.is_null(table["rejected"]))
    return TextureLibrary(usable, root or Path(metadata[b"root"].decode(errors="surrogateescape")))
