"""What lies in a store, to be compared with what lies on the disk."""

import hashlib

from tableverse_factory.core.storage.files import StoragePath, get_store


def digests_in(place: StoragePath) -> dict[str, str]:
    """Sha256 of every object below a prefix but the timings and what the stages gave."""
    fs = get_store(place)
    names = [
        name for name in fs.list_sizes(place.path, recursive=True) if not name.startswith(("timings/", ".stages/"))
    ]
    return {name: hashlib.sha256(fs.cat_file(f"{place.path}/{name}")).hexdigest() for name in names}
