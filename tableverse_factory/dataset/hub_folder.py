"""Dataset on the Hugging Face Hub, read at one commit: later pushes do not mix into it."""

from collections.abc import Mapping
from typing import Any

from tableverse_factory.dataset.http_dataset import WebFolder
from tableverse_factory.dataset.hub_client import call_hub
from tableverse_factory.dataset.hub_names import LIBRARY, make_hub_api, parse_hub_address


class HubFolder(WebFolder):
    """Files of a dataset at a commit; the Hub lists them, and byte ranges are read as from any server."""

    protocol = "tableverse-hub"

    def __init__(self, address: str, name: str, commit: str, **options: Any) -> None:
        """Send no request yet; `address` is that of the files of the commit."""
        super().__init__(address, **options)
        self._name, self._commit = name, commit

    def headers(self) -> Mapping[str, str]:
        """Return the token, if there is one, for the Hub alone and never for a redirection's target."""
        from huggingface_hub.utils import build_hf_headers

        return build_hf_headers(library_name=LIBRARY)

    def sizes(self, folder: str) -> dict[str, int]:
        """List the names and sizes [bytes] of the files in a folder."""
        from huggingface_hub.errors import EntryNotFoundError
        from huggingface_hub.hf_api import RepoFile

        def list_files() -> list[Any]:
            try:
                return list(
                    make_hub_api().list_repo_tree(self._name, folder, revision=self._commit, repo_type="dataset")
                )
            except EntryNotFoundError:
                return []

        found = call_hub(f"hf://datasets/{self._name}", list_files)
        return {entry.path.rpartition("/")[2]: entry.size for entry in found if isinstance(entry, RepoFile)}


def open_hub_folder(text: str) -> HubFolder:
    """Open the dataset at `hf://datasets/OWNER/NAME[@REVISION]` at the commit that the revision names now."""
    (name, revision), api = parse_hub_address(text), make_hub_api()
    place = f"hf://datasets/{name}@{revision}"
    commit = call_hub(place, lambda: api.repo_info(name, revision=revision, repo_type="dataset").sha)
    return HubFolder(f"{api.endpoint}/datasets/{name}/resolve/{commit}", name, str(commit))
