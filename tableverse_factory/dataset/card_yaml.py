"""YAML front matter of a dataset card for the Hugging Face Hub: licences, sizes, and a table per config."""

import re
from collections.abc import Iterable, Sequence

import yaml

SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
_TAGS = ["mujoco", "simulation", "robotics", "table-top", "3d"]
# Licence names that the Hub knows, and its names of some SPDX identifiers
_HUB_LICENCES = re.compile(
    r"apache-2\.0|mit|bsd(-[23]-clause)?|isc|ncsa|unlicense|wtfpl|zlib|gfdl|gpl-3\.0|odbl|odc-by|pddl"
    r"|cc0-1\.0|cc-by-(2\.0|2\.5|3\.0|4\.0)|cc-by-sa-[34]\.0|cc-by-nc-[234]\.0|cc-by-nc-sa-[234]\.0|cc-by-nd-4\.0"
    r"|cc-by-nc-nd-[34]\.0|cdla-permissive-[12]\.0|cdla-sharing-1\.0"
)
_HUB_NAMES = {
    "cc0": "cc0-1.0",
    "odbl-1.0": "odbl",
    "odc-by-1.0": "odc-by",
    "pddl-1.0": "pddl",
    "gpl-3.0-only": "gpl-3.0",
    "gpl-3.0-or-later": "gpl-3.0",
}


def make_front_matter(n_scenes: int, licences: Iterable[str], tables: Sequence[str]) -> str:
    """Make the front matter, with its two lines of dashes; the first of `tables` is the default.

    `licences` are the names of those that bind the scenes, empty if none is stated.
    """
    head = {
        "pretty_name": "Table-top scenes for MuJoCo",
        **make_license_keys(licences),
        "size_categories": [name_size(n_scenes)],
        "task_categories": ["robotics"],
        "tags": _TAGS,
        "configs": [
            {
                "config_name": table,
                **({"default": True} if table == tables[0] else {}),
                "data_files": [{"split": "train", "path": f"{table}/shard-*.parquet"}],
            }
            for table in tables
        ],
    }
    return f"---\n{yaml.safe_dump(head, sort_keys=False)}---"


def name_size(rows: int) -> str:
    """Name the size as the Hub does."""
    return next((name for limit, name in SIZES if rows < limit), "1M<n<10M")


def make_license_keys(licences: Iterable[str]) -> dict[str, object]:
    """Name the licences as the Hub does; `other` if it does not know them all."""
    plain = ("-".join(licence.lower().split()) for licence in licences)
    names = sorted({_HUB_NAMES.get(name, name) for name in plain})
    if not names or not all(map(_HUB_LICENCES.fullmatch, names)):
        return {"license": "other", "license_name": "stated-for-each-scene"}
    return {"license": names[0] if len(names) == 1 else names}
