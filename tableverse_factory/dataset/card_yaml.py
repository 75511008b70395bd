"""The head of a dataset card, in the YAML that the Hugging Face Hub reads: licences, sizes, and a table per config."""

from collections.abc import Iterable, Sequence

import yaml

SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
_TAGS = ("mujoco", "simulation", "robotics", "table-top", "3d")

_HUB_LICENCES = frozenset(
    [
        "apache-2.0",
        "mit",
        "bsd",
        "bsd-2-clause",
        "bsd-3-clause",
        "cc0-1.0",
        "cc-by-2.0",
        "cc-by-2.5",
        "cc-by-3.0",
        "cc-by-4.0",
        "cc-by-sa-3.0",
        "cc-by-sa-4.0",
        "cc-by-nc-2.0",
        "cc-by-nc-3.0",
        "cc-by-nc-4.0",
        "cc-by-nc-sa-2.0",
        "cc-by-nc-sa-3.0",
        "cc-by-nc-sa-4.0",
        "cc-by-nd-4.0",
        "cc-by-nc-nd-3.0",
        "cc-by-nc-nd-4.0",
        "cdla-permissive-1.0",
        "cdla-permissive-2.0",
        "cdla-sharing-1.0",
        "gfdl",
        "gpl-3.0",
        "isc",
        "ncsa",
        "odbl",
        "odc-by",
        "pddl",
        "unlicense",
        "wtfpl",
        "zlib",
    ]
)
"""Names of licences that the Hub knows."""

_HUB_NAMES = {
    "cc0": "cc0-1.0",
    "odbl-1.0": "odbl",
    "odc-by-1.0": "odc-by",
    "pddl-1.0": "pddl",
    "gpl-3.0-only": "gpl-3.0",
    "gpl-3.0-or-later": "gpl-3.0",
}
"""What the Hub calls some SPDX identifiers."""


def make_front_matter(n_scenes: int, licences: Iterable[str], tables: Sequence[str]) -> str:
    """The head, between its two lines of dashes.

    Args:
        n_scenes: How many scenes the dataset has.
        licences: What binds them, by name; empty where none is stated.
        tables: Which tables have rows; the first is shown first.
    """
    head = {
        "pretty_name": "Table-top scenes for MuJoCo",
        **_licence(licences),
        "size_categories": [next((name for limit, name in SIZES if n_scenes < limit), "1M<n<10M")],
        "task_categories": ["robotics"],
        "tags": list(_TAGS),
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


def _licence(licences: Iterable[str]) -> dict[str, object]:
    """One name or several that the Hub knows; `other` where it does not know them all."""
    names = sorted({_hub_name(licence) for licence in licences})
    if not names or not _HUB_LICENCES.issuperset(names):
        return {"license": "other", "license_name": "stated-for-each-scene"}
    return {"license": names[0] if len(names) == 1 else names}


def _hub_name(licence: str) -> str:
    name = "-".join(licence.lower().split())
    return _HUB_NAMES.get(name, name)
