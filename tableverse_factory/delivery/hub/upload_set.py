"""Files of a dataset that an upload takes, and reasons to refuse it."""

import shlex
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow.compute as pc

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.files import list_names
from tableverse_factory.dataset.card import make_dataset_card
from tableverse_factory.dataset.committed_rows import read_shard
from tableverse_factory.dataset.consolidated_tables import MERGED
from tableverse_factory.dataset.integrity import check_files, check_tars
from tableverse_factory.dataset.licences import PROFILES, LicenceVerdict, scene_license
from tableverse_factory.dataset.shard_plan import read_plan
from tableverse_factory.dataset.shards import FOLDERS, SPARSE, committed_shards, shard_name
from tableverse_factory.delivery.license_filter import redact_config, redact_uri
from tableverse_factory.run_record import read_run

CARD = "README.md"
_HEAD = ("run.json", "plan.parquet")
_COLUMNS = ("licence", "mesh_licences", "uri", "detail", "tar_offset")


@dataclass(frozen=True, slots=True)
class UploadSet:
    """Dataset as it would be uploaded."""

    out: Path
    run: Mapping[str, Any]  # `run.json`
    n_shards: int  # planned
    shards: tuple[int, ...]  # committed, in order
    card: bytes  # `README.md`
    sizes: Mapping[str, int]  # of all other files, by path below `out` [bytes]
    scenes: int
    with_files: int
    licences: Mapping[str, int]  # scenes by name; empty if none is stated
    verdicts: Mapping[LicenceVerdict, int]  # scenes by what licences of picture and meshes allow, the freest first
    private_values: int  # rows and configuration values that name files or addresses of the building machine

    @property
    def n_bytes(self) -> int:
        """Size of the whole upload [bytes]."""
        return sum(self.sizes.values()) + len(self.card)

    def files_of(self, shard: int) -> Iterator[str]:
        """List the paths of a shard's files below `out`, the one that commits it last."""
        names = (f"{folder}/{shard_name(folder, shard)}" for folder in {**SPARSE, **FOLDERS})
        return (name for name in names if name in self.sizes)

    def head(self) -> Iterator[str]:
        """List the paths of what is read before any shard, below `out`."""
        return (name for name in _HEAD if name in self.sizes)

    def tail(self) -> Iterator[str]:
        """List the paths of the merged tables, below `out`."""
        return (name for name in self.sizes if name.startswith(f"{MERGED}/"))


def collect_upload_set(out: Path) -> UploadSet:
    """Collect everything that would be uploaded; nothing is written or sent."""
    run, plan = read_run(out / "run.json"), read_plan(out / "plan.parquet")
    shards = tuple(sorted(number for number in committed_shards(out) if number < plan.n_shards))
    if not shards:
        raise InputError(f"{out} has no finished shard yet: build on first")
    check_files(out, shards)
    check_tars(out, shards)
    licences: Counter[str] = Counter()
    verdicts: Counter[LicenceVerdict] = Counter()
    with_files, private_values = 0, int(redact_config(run.get("config", {})) != run.get("config", {}))
    for number in shards:
        table = read_shard(out, "scenes", number, _COLUMNS)
        licences.update(licence or "" for licence in table["licence"].to_pylist())
        verdicts.update(map(scene_license, table.select(["licence", "mesh_licences"]).to_pylist()))
        with_files += table.num_rows - table["tar_offset"].null_count
        named = [uri != redact_uri(uri) for uri in pc.fill_null(table["uri"], "").to_pylist()]
        told = [detail is not None for detail in table["detail"].to_pylist()]
        private_values += sum(a or b for a, b in zip(named, told, strict=True))
    return UploadSet(
        out,
        run,
        plan.n_shards,
        shards,
        _read_or_make_card(out, run, shards),
        _list_sizes(out, shards, whole=len(shards) == plan.n_shards),
        licences.total(),
        with_files,
        dict(licences.most_common()),
        {verdict: verdicts[verdict] for verdict in LicenceVerdict if verdicts[verdict]},
        private_values,
    )


def find_refusals(contents: UploadSet, unfinished: bool) -> list[str]:
    """Find the reasons not to upload it, each with what to do."""
    found = []
    missing = contents.n_shards - len(contents.shards)
    if missing and not unfinished:
        found.append(
            f"{missing} of {contents.n_shards} shards are missing: build on first, or give --unfinished to upload what "
            "there is"
        )
    profile = _choose_profile(contents.verdicts)
    forbidden = {verdict: count for verdict, count in contents.verdicts.items() if verdict not in PROFILES[profile]}
    option = " --unfinished" if missing and unfinished else ""
    out, public = shlex.quote(str(contents.out)), shlex.quote(f"{contents.out}-public")
    export = f"tableverse export {out} {public} --profile {profile}{option}"
    if forbidden:
        counts = ", ".join(f"{count} {verdict.value}" for verdict, count in forbidden.items())
        total = sum(forbidden.values())
        found.append(f"{total} scenes may not be passed on ({counts}): `{export}` writes a dataset without them")
    if contents.private_values:
        found.append(
            f"{contents.private_values} rows or values name files or addresses of this machine (uri, detail, config): "
            f"`{export}` writes a dataset without these"
        )
    return found


def _choose_profile(verdicts: Collection[LicenceVerdict]) -> str:
    """Choose the strictest profile that keeps every scene that may be redistributed."""
    widest = PROFILES["non-commercial"]
    return next(name for name, allowed in PROFILES.items() if allowed.issuperset(widest.intersection(verdicts)))


def _read_or_make_card(out: Path, run: Mapping[str, Any], shards: Collection[int]) -> bytes:
    """Read the card if it has the front matter that the Hub reads; otherwise make it from the shards."""
    path = out / CARD
    text = path.read_bytes() if path.is_file() else b""
    return text if text.startswith(b"---\n") else make_dataset_card(out, run, tuple(shards)).encode()


def _list_sizes(out: Path, shards: Collection[int], whole: bool) -> dict[str, int]:
    """List the sizes of everything that belongs to the dataset, and of nothing else in its folder [bytes]."""
    names = [*_HEAD, *(f"{folder}/{shard_name(folder, shard)}" for shard in shards for folder in FOLDERS | SPARSE)]
    names += [f"{MERGED}/{name}" for name in list_names(out / MERGED) if whole and name.endswith(".parquet")]
    return {name: (out / name).stat().st_size for name in names if (out / name).is_file()}
