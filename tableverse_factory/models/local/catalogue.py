"""Catalogue of the models that the line can use: address, pinned commit, files, licence and what it forbids.

Commits and hashes are those of the Hub as at least two unrelated public projects record them, sizes as at least one
does; None or empty where they are unknown. No download of our own has confirmed them (docs/models.md).
"""

from dataclasses import dataclass
from typing import Literal

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line

Role = Literal["detector", "segmenter", "depth", "completion"]


@dataclass(frozen=True, slots=True)
class WeightFile:
    """A file of a repository; size [bytes] and sha256 where they are known."""

    name: str
    size: int | None = None
    sha256: str = ""


@dataclass(frozen=True, slots=True)
class ModelEntry:
    """A model by its name in this table.

    `backend` is its value of the key of its role; `files` is empty where its own program fetches the weights.
    `loaded_by` names what loads it, empty for this project's extra `models`.
    """

    name: str
    role: Role
    backend: str
    purpose: str
    repository: str
    revision: str
    licence: str
    forbids: str
    files: tuple[WeightFile, ...] = ()
    is_gated: bool = False
    loaded_by: str = ""

    @property
    def weights(self) -> str:
        """The name on the Hub with its commit, as the configuration takes it."""
        return f"{self.repository}@{self.revision}" if self.revision else self.repository

    @property
    def size(self) -> int | None:
        """Bytes of the files whose size is known; None if none is."""
        return sum(file.size or 0 for file in self.files) or None


_SAM_LICENCE = "military and weapons uses, among others: read it before you publish results"
_CONFIG = WeightFile("config.json")
_FROM_DA3 = "its authors' package: pip install 'git+https://github.com/ByteDance-Seed/Depth-Anything-3'"


def _weights(size: int, sha256: str) -> WeightFile:
    return WeightFile("model.safetensors", size, sha256)


CATALOGUE = (
    ModelEntry(
        name="grounding-dino-tiny",
        role="detector",
        backend="grounding_dino",
        purpose="boxes of the things that perceive.vocabulary names",
        repository="IDEA-Research/grounding-dino-tiny",
        revision="a2bb814dd30d776dcf7e30523b00659f4f141c71",
        licence="Apache-2.0",
        forbids="",
        files=(
            _CONFIG,
            _weights(689_359_096, "1a2412ef99bd74bcd3c2a246fa1e48581f8889a1300c9051974741314fc042f3"),
            WeightFile("tokenizer.json"),
            WeightFile("tokenizer_config.json"),
        ),
    ),
    ModelEntry(
        name="sam2.1-large",
        role="segmenter",
        backend="sam2",
        purpose="masks from boxes, the paper's",
        repository="facebook/sam2.1-hiera-large",
        revision="665f8e2ad61cf5f53d65644ff27c8ee525124610",
        licence="Apache-2.0",
        forbids="",
        files=(
            _CONFIG,
            _weights(897_897_416, "dc407dce21301fd94abb395c5099b4f2c455fdc8a8f261ac3d0ea6d4cd197230"),
        ),
    ),
    ModelEntry(
        name="sam2.1-tiny",
        role="segmenter",
        backend="sam2",
        purpose="masks from boxes, small enough for a CPU",
        repository="facebook/sam2.1-hiera-tiny",
        revision="de431c4043854a71d8101e17995dfe596bf101a5",
        licence="Apache-2.0",
        forbids="",
        files=(
            _CONFIG,
            _weights(155_908_064, "48c14467e5cf9e51870511feb72c89688e82dd74523142c0538b663e193ac2a7"),
        ),
    ),
    ModelEntry(
        name="sam3",
        role="segmenter",
        backend="sam3",
        purpose="masks from boxes",
        repository="facebook/sam3",
        revision="3c879f39826c281e95690f02c7821c4de09afae7",
        licence="SAM Licence",
        forbids=_SAM_LICENCE,
        files=(
            _CONFIG,
            _weights(3_439_938_512, "6d06f0a5f84e435071fe6603e61d0b4cc7b40e0d39d487cfd4d67d8cc11cc14a"),
        ),
        is_gated=True,
    ),
    ModelEntry(
        name="depth-anything-v2-small",
        role="depth",
        backend="depth_anything_2",
        purpose="metric depth indoors without a camera, small enough for a CPU",
        repository="depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf",
        revision="8078d68a9c75a972131914f6afd0c1723be0da7f",
        licence="Apache-2.0",
        forbids="",
        files=(
            _CONFIG,
            _weights(99_173_660, "e990eb82fbf11b05b7813261196a2b841bdcf5a05f64396724a8987fa90504a3"),
        ),
    ),
    ModelEntry(
        name="da3-metric-large",
        role="depth",
        backend="depth_anything_3",
        purpose="metric depth without a camera",
        repository="depth-anything/DA3METRIC-LARGE",
        revision="4010e39f3634a45bc60553321fb49fb760bd594e",
        licence="Apache-2.0",
        forbids="",
        files=(
            _CONFIG,
            _weights(1_336_734_448, "bbea5b0b3ee389849cffa7ddae89de064a90abd2b055fc5aa99aac68db324776"),
        ),
        loaded_by=_FROM_DA3,
    ),
    ModelEntry(
        name="da3-nested",
        role="depth",
        backend="depth_anything_3_nested",
        purpose="metric depth and camera, the paper's",
        repository="depth-anything/DA3NESTED-GIANT-LARGE-1.1",
        revision="b2359bdf726fb44ef62acca04d629dcf158053e7",
        licence="CC-BY-NC-4.0",
        forbids="commercial use",
        files=(
            _CONFIG,
            _weights(6_759_558_100, "8ebe871a022ed58d2fc8fdfb2ebdb31d57b60fe39611c849095851a7b7c6020c"),
        ),
        loaded_by=_FROM_DA3,
    ),
    ModelEntry(
        name="moge-2",
        role="depth",
        backend="moge_2",
        purpose="metric depth and camera",
        repository="Ruicheng/moge-2-vitl",
        revision="39c4d5e957afe587e04eec59dc2bcc3be5ecd968",
        licence="MIT",
        forbids="",
        loaded_by="MoGe's own package, whose weights are a pickle (docs/models.md)",
    ),
    ModelEntry(
        name="sam-3d-objects",
        role="completion",
        backend="sam3d",
        purpose="meshes from masks, the paper's",
        repository="facebook/sam-3d-objects",
        revision="",
        licence="SAM Licence",
        forbids=_SAM_LICENCE,
        is_gated=True,
        loaded_by="its own process and environment (docs/mesh-process.md)",
    ),
    ModelEntry(
        name="triposr",
        role="completion",
        backend="triposr",
        purpose="meshes from masks",
        repository="stabilityai/TripoSR",
        revision="",
        licence="MIT",
        forbids="",
        loaded_by="its own process and environment (docs/mesh-process.md)",
    ),
)
DEFAULT_WEIGHTS = {model.backend: model.weights for model in reversed(CATALOGUE)}  # the first of each backend
BY_REPOSITORY = {model.repository: model for model in CATALOGUE}
_BY_NAME = {model.name: model for model in CATALOGUE}


def get_model(name: str) -> ModelEntry:
    """Get the model of a name in the table; InputError if there is none."""
    if name not in _BY_NAME:
        raise InputError(f"no model {sanitize_line(name, 80)!r}: there are {', '.join(_BY_NAME)}", "no_such_model")
    return _BY_NAME[name]
