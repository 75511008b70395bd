"""`tableverse publish`: upload of a dataset to the Hugging Face Hub."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import pluralize, sanitize_line

if TYPE_CHECKING:
    from tableverse_factory.delivery.hub.upload_set import UploadSet

_SHOWN_LICENCES = 10


def publish(
    out: Annotated[
        Path, typer.Argument(help="What `tableverse export OUT DEST` wrote, or an OUT that names no private places.")
    ],
    repo: Annotated[str, typer.Option("--repo", help="Its name on the Hub: OWNER/NAME.")],
    public: Annotated[bool, typer.Option("--public", help="Let everybody read it; without, only its owner.")] = False,
    replace: Annotated[bool, typer.Option("--replace", help="Replace another dataset of this name.")] = False,
    card: Annotated[bool, typer.Option("--card", help="Replace a README.md that was edited on the Hub.")] = False,
    unfinished: Annotated[bool, typer.Option("--unfinished", help="Upload the shards that there are.")] = False,
    upload: Annotated[bool, typer.Option("--upload", help="Do it; without, only say what would go.")] = False,
) -> None:
    """Upload a dataset to the Hugging Face Hub.

    Without --upload, only print what would be uploaded.

    The token comes from HF_TOKEN or from `hf auth login`. After a kill, the same command uploads what is missing. Needs
    huggingface_hub: `pip install 'tableverse-factory[hub]'`.

    Example: `tableverse publish out-public --repo me/table-tops --upload`
    """
    from tableverse_factory.dataset.hub_names import check_hub_name, make_hub_api
    from tableverse_factory.delivery.hub.upload_set import collect_upload_set, find_refusals

    name, endpoint = check_hub_name(repo), make_hub_api().endpoint
    contents = collect_upload_set(out)
    print(f"{out} → {endpoint}/datasets/{name}, {'public' if public else 'private'}")
    _print_contents(contents)
    if problems := find_refusals(contents, unfinished):
        raise InputError("it must not be uploaded: " + "; ".join(problems))
    if not upload:
        given = {"--public": public, "--replace": replace, "--card": card, "--unfinished": unfinished}
        options = "".join(f" {option}" for option, on in given.items() if on)
        command = f"tableverse publish {shlex.quote(str(out))} --repo {name}{options} --upload"
        print(f"Nothing was uploaded. This does it:\n  {command}")
        return
    from tableverse_factory.delivery.hub.upload import UploadOptions
    from tableverse_factory.delivery.hub.upload import upload as send

    print(f"done: {send(contents, name, UploadOptions(public, replace, card), lambda line: print(line, flush=True))}")


def _print_contents(contents: "UploadSet") -> None:
    from tableverse_factory.dataset.licences import LicenceVerdict

    files = pluralize(len(contents.sizes) + 1, "file")
    shards = f"{len(contents.shards)} of {pluralize(contents.n_shards, 'shard')}"
    print(f"  {files}, {contents.n_bytes / 1e6:,.1f} MB: {shards}")
    print(f"  {pluralize(contents.scenes, 'scene')}, {contents.with_files} of them with files")
    shown = list(contents.licences.items())[:_SHOWN_LICENCES]
    print("  licences: " + ", ".join(f"{sanitize_line(name, 60) or 'not stated'} ({count})" for name, count in shown))
    strict = [(each, count) for each, count in contents.verdicts.items() if each is not LicenceVerdict.PERMISSIVE]
    kinds = f" ({', '.join(f'{count} {verdict.value}' for verdict, count in strict)})" if strict else ""
    print(f"  not permissive: {pluralize(sum(count for _, count in strict), 'scene')}{kinds}")
