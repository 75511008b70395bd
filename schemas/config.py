"""Configuration, a section per stage. Every key has a default and a docstring; unknown keys are errors."""

from abc import abstractmethod
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator
from pydantic_core import PydanticCustomError

from schemas.address import ModelUrl
from schemas.config_values import VOCABULARY, Interval, KeyVariable, Metres, ModelName, Positive, Vocabulary, Weights

MODEL_LOAD_S = 1200.0  # wall time in which a model downloads and loads its weights, and its process starts [s]
MAX_SLOW_MESHES = 30  # objects of a scene that may each take the whole `place.mesh_timeout_s`; most take much less


class Section(BaseModel):
    """Base of the sections."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    @field_validator("*", mode="before")
    @classmethod
    def _refuse_booleans(cls, value: object, info: ValidationInfo) -> object:
        # pydantic takes true for 1, and YAML takes yes and on for true
        values = value if isinstance(value, list | tuple) else [value]
        if cls.model_fields[str(info.field_name)].annotation is not bool and any(isinstance(v, bool) for v in values):
            raise PydanticCustomError("boolean", "give a number or a text")
        return value


class StageSection(Section):
    """Base of the sections of stages."""

    deadline_s: Positive | None = None
    """Wall time of this stage on one scene; null for `run.deadline_s` [s]."""

    def resolve_deadline(self, run_deadline_s: float) -> float:
        """Resolve the wall time of the stage, given that of the run [s]."""
        return run_deadline_s + self._extra_s if self.deadline_s is None else self.deadline_s

    @property
    def _extra_s(self) -> float:  # beyond the deadline of the run, such as to load weights
        return 0.0


class RemoteModelSection(StageSection):
    """Base of the sections of stages that may send requests to a model server."""

    base_url: ModelUrl = ""
    """Of `openai`, e.g. `http://localhost:8000/v1`; `gemini` has its public one. https but on localhost."""
    model: ModelName = ""
    """Name of the model on the server."""
    key_env: KeyVariable = ""
    """Name of the environment variable that holds the API key; empty for a server without keys."""
    enforce_schema: bool = True
    """Whether the answer's schema is sent for the server to enforce; false for servers that refuse it."""
    timeout_s: Positive = 240.0
    """Time limit of one answer with all retries; less than the stage's deadline [s]."""
    usd_per_million_input: Annotated[float, Field(ge=0.0, le=1e6, allow_inf_nan=False)] = 0.0
    """Price of a million input tokens [USD]."""
    usd_per_million_output: Annotated[float, Field(ge=0.0, le=1e6, allow_inf_nan=False)] = 0.0
    """Price of a million output tokens [USD]."""

    @property
    @abstractmethod
    def protocol(self) -> str:
        """Protocol of the model server, `openai` or `gemini`; empty if no model is asked."""

    def find_missing_keys(self) -> list[str]:
        """Find the keys without which the model cannot be asked."""
        missing = {
            "model": bool(self.protocol) and not self.model,
            "base_url": self.protocol == "openai" and not self.base_url,
            "key_env": self.protocol == "gemini" and not self.key_env,
        }
        return [name for name, is_missing in missing.items() if is_missing]


class AskingConfig(Section):
    """Limits on requests to model servers, on each machine. They change no answer."""

    max_parallel: Annotated[int, Field(ge=1, le=1024)] = 8
    """Concurrent requests."""
    per_minute: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """Requests begun within a minute; 0 for no limit."""


class ModelsConfig(Section):
    """Device and precision of models with local weights."""

    device: Literal["auto", "cpu", "cuda"] = "auto"
    """`auto` is the GPU if torch can use one. Results differ in a few pixels between devices."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """`auto` is bfloat16 on a GPU and float32 on a CPU."""


class ObserveConfig(StageSection):
    """Limits on decoded inputs, and the source of depth."""

    max_pixels: Annotated[int, Field(ge=1, le=178_000_000)] = 40_000_000
    """Largest picture, by its header; a larger one is refused before it is decoded."""
    max_file_bytes: Annotated[int, Field(ge=1)] = 256 * 1024 * 1024
    """Largest input file [bytes]."""
    max_depth_m: Positive = 5.0
    """Largest depth that is used [m]."""
    depth: Literal[
        "picture", "sensor", "recorded", "depth_anything_3", "depth_anything_3_nested", "moge_2", "depth_anything_2"
    ] = "picture"
    """Source of the depth of a bare picture: `picture` is our own net, `recorded` reads `NAME.depth.npy` and
    `NAME.camera.json` beside it, `sensor` has none for it. A capture always has its own.
    """
    depth_weights: Weights = ""
    """Folder, or `owner/name` or `owner/name@revision` on the Hub, of the depth model; an `.onnx` file of `picture`.
    Empty for the published ones.
    """
    focal_px: Annotated[float, Field(gt=0.0, le=1e6, allow_inf_nan=False)] | None = None
    """Focal length of bare pictures that neither the model nor EXIF gives [px]; null: 58 degrees on the longer side,
    and with `picture` 46 or 34 where the net is surer of the table so.
    """
    min_table_probability: Annotated[float, Field(ge=0.0, le=1.0)] = 0.92
    """`picture`: least probability that a table-top is shown; else the picture is dropped as `no_table`."""
    table_distance_m: Interval = (0.1, 4.0)
    """`picture`: least and greatest distance of the camera from the table's plane [m]."""
    min_view_deg: Annotated[float, Field(ge=0.0, le=90.0)] = 8.0
    """`picture`: least angle between the camera's axis and the table [degrees]."""
    max_roll_deg: Annotated[float, Field(ge=0.0, le=90.0)] = 40.0
    """`picture`: greatest angle between the table's normal and the camera's vertical plane [degrees]."""

    @property
    def _extra_s(self) -> float:
        return 0.0 if self.depth in ("picture", "sensor", "recorded") else MODEL_LOAD_S


class PerceiveConfig(RemoteModelSection):
    """Detector, segmenter and limits on objects."""

    detector: Literal["auto", "geometric", "picture", "ensemble", "replay", "grounding_dino", "openai", "gemini"] = (
        "auto"
    )
    """`auto` replays `detections.json` if the capture has one, with `masks.png` if it is there; else it is `ensemble`
    where a sensor measured depth, and `picture`, our own net, where a model estimated it. `geometric` is depth alone;
    `ensemble` takes, for each group of objects that overlap or hold one another, the answer of depth, of depth and the
    net, or of the net, whichever explains the picture better; without a sensor it is `picture`. `grounding_dino` finds
    the things of `vocabulary` by colour, `openai` is any server of OpenAI's chat completions, `gemini` Google's own
    protocol.
    """
    detector_weights: Weights = ""
    """The `.onnx` file of `picture`, whose own is in the package; of `grounding_dino` a folder, or `owner/name` or
    `owner/name@revision` on the Hub, empty for the published ones.
    """
    vocabulary: Vocabulary = VOCABULARY
    """Things that `grounding_dino` looks for: English nouns in lower case. The table and people are found besides."""
    detector_score: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.3
    """Least score of a box of `grounding_dino`."""
    detector_overlap: Annotated[float, Field(gt=0.0, le=1.0)] = 0.7
    """Of two boxes of `grounding_dino` with a larger intersection over union, the one with the higher score stays."""
    box_order: Literal["auto", "xyxy", "yxyx"] = "auto"
    """Coordinate order of the model's boxes; `auto` is yxyx for `gemini`, else xyxy."""
    segmenter: Literal["geometric", "picture", "sam2", "sam3"] = "geometric"
    """Converts boxes to masks, for detectors that give boxes: `replay` without `masks.png`, `grounding_dino`, `openai`,
    `gemini`. Our own from depth, our net of bare pictures, or a model with weights.
    """
    segmenter_weights: Weights = ""
    """Folder, or `owner/name` or `owner/name@revision` on the hub, of the segmenter; an `.onnx` file of `picture`.
    Empty for the published ones.
    """
    segmenter_batch: Annotated[int, Field(ge=1, le=256)] = 8
    """Pictures per batch of the segmenter on a GPU."""
    max_objects: Annotated[int, Field(ge=1, le=200)] = 60
    """Most objects that are kept of one picture."""
    min_explained: Annotated[float, Field(ge=0.0, le=1.0)] = 0.65
    """Least share of the area above the table that the objects must explain; a scene with less is dropped."""

    @property
    def protocol(self) -> str:
        """Protocol of the detector's server; empty if no model is asked."""
        return self.detector if self.detector in ("openai", "gemini") else ""

    @property
    def _extra_s(self) -> float:
        loads = (self.segmenter not in ("geometric", "picture")) + (self.detector == "grounding_dino")
        return MODEL_LOAD_S * loads

    @model_validator(mode="after")
    def _check_required_keys(self) -> "PerceiveConfig":
        names = [f"perceive.{name}" for name in self.find_missing_keys()]
        if names:
            raise ValueError(f"the detector {self.detector!r} needs {' and '.join(names)}")
        if self.detector in ("auto", "geometric", "picture", "ensemble") and self.segmenter != "geometric":
            where = " where a capture has no detections.json" if self.detector == "auto" else ""
            raise ValueError(
                f"the detector {self.detector!r} gives masks, not boxes{where}, so perceive.segmenter "
                f"{self.segmenter!r} would do nothing: set perceive.detector to 'replay' (the boxes of "
                "detections.json), 'grounding_dino', 'openai' or 'gemini', or leave the segmenter 'geometric'"
            )
        return self


class PlaceConfig(StageSection):
    """Completion and registration of meshes."""

    mesh_model: Literal["carved", "replay", "sam3d", "triposr"] = "carved"
    """`carved` completes what the picture shows; `replay` registers the meshes recorded in `meshes/` of the capture;
    `sam3d` and `triposr` are models in a process of their own."""
    mesh_command: Annotated[tuple[Annotated[str, Field(max_length=4096)], ...], Field(max_length=64)] = ()
    """Program and arguments that start the process of the mesh model."""
    mesh_timeout_s: Positive = 120.0
    """Longest silence of that process during one object's mesh [s]."""

    @property
    def _in_process(self) -> bool:
        return self.mesh_model in ("sam3d", "triposr")

    @property
    def _extra_s(self) -> float:
        return MODEL_LOAD_S + MAX_SLOW_MESHES * self.mesh_timeout_s if self._in_process else 0.0

    @model_validator(mode="after")
    def _check_required_keys(self) -> "PlaceConfig":
        if self._in_process and not self.mesh_command:
            raise ValueError(f"the mesh model {self.mesh_model!r} needs place.mesh_command (docs/mesh-process.md)")
        return self


class RectifyConfig(StageSection):
    """Convex pieces, and the method of moving objects apart."""

    method: Literal["joint", "lccr"] = "joint"
    """`joint` moves the whole layout least and keeps who carries whom (docs/concepts.md); `lccr` is the paper's."""
    clearance_m: Metres = 0.0005
    """Gap between objects, in addition to what their meshes stick out of their pieces [m]."""
    contact_m: Metres = 0.01
    """Objects with at most this gap count as touching; about the noise of registration [m]."""
    overlap_ratio: Annotated[float, Field(gt=0.0, le=1.0)] = 0.5
    """`lccr`: touching objects whose boxes, seen from above, share this much of the smaller's area are one group."""
    decomposition: Literal["cut", "coacd"] = "cut"
    """Convex decomposition of meshes: our own cuts and merges, or CoACD as in the paper (docs/benchmarks.md)."""
    volume_error: Annotated[float, Field(gt=0.0, le=10.0)] = 0.1
    """Pieces may add up to this share of a mesh's volume, if `max_pieces` allows."""
    max_pieces: Annotated[int, Field(ge=1, le=256)] = 48
    """Convex pieces per object."""
    max_contents: Annotated[int, Field(ge=0, le=200)] = 60
    """Most objects in the containers of one scene, counted copies included; the rest is left out."""
    fall_time_s: Annotated[float, Field(ge=1.0, le=20.0)] = 3.0
    """Simulated time within which an object dropped into a container must come to rest [s]."""


class SettleConfig(StageSection):
    """Forward simulation to rest."""

    timestep_s: Annotated[float, Field(ge=0.0002, le=0.005)] = 0.002
    """Step of the simulation, also written into the exported XML [s]."""
    max_time_s: Annotated[float, Field(ge=0.5, le=60.0)] = 6.0
    """Simulated time within which a scene must come to rest; restless objects get it a second time [s]."""


class CurateConfig(RemoteModelSection):
    """Judge."""

    judge: Literal["rules", "openai", "gemini", "replay"] = "rules"
    """`rules` needs no model; `openai` is any server of OpenAI's chat completions, `gemini` Google's own protocol."""
    replay_dir: Annotated[str, Field(max_length=4096)] = ""
    """Folder of recorded answers for the judge `replay`: `<scene_id>.json` each. Its content is part of the run."""
    max_tasks: Annotated[int, Field(ge=0, le=100)] = 20
    """Most tasks that the rules make for a scene."""
    gripper_width_m: Positive = 0.078
    """Widest opening of the gripper that tasks are meant for [m]."""
    max_grasp_mass_kg: Positive = 2.0
    """Largest mass that this gripper lifts [kg]."""

    @property
    def protocol(self) -> str:
        """Protocol of the judge's server; empty if no model is asked."""
        return self.judge if self.judge in ("openai", "gemini") else ""

    @model_validator(mode="after")
    def _check_required_keys(self) -> "CurateConfig":
        names = [f"curate.{name}" for name in self.find_missing_keys()]
        if self.judge == "replay" and not self.replay_dir:
            names.append("curate.replay_dir")
        if names:
            raise ValueError(f"the judge {self.judge!r} needs {' and '.join(names)}")
        return self


class ExportConfig(StageSection):
    """The files of a scene and its certificate."""

    epsilon_m: Metres = 0.001
    """Pairs deeper than this collide, and the scene is dropped [m]."""
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] = 90
    """JPEG quality of `observation/color.jpg`, from which the textures are made too."""
    surroundings: Literal["plain", "photograph"] = "plain"
    """`photograph` shows the picture's table and background without its objects; `plain` a table of its colour."""
    poses: Literal["settled", "rectified", "placed"] = "settled"
    """Poses of the objects. `rectified` leaves out settling, `placed` rectification too; such scenes may collide and
    move, as their certificate then says. For experiments (docs/policies.md).
    """


class TrajectoriesConfig(StageSection):
    """Grasps, placements and motions for the accepted tasks of a scene, each verified in simulation."""

    deadline_s: Positive | None = None
    """Wall time of all tasks of one scene; null for `run.deadline_s` and `task_deadline_s` for each of `max_tasks`."""
    robot: Annotated[str, Field(min_length=1, max_length=4096)] = "panda"
    """`panda` is our own; `menagerie:NAME` comes from the package mujoco-menagerie; else a file `….xml` of an arm."""
    grasp_model: Literal["antipodal", "graspgen"] = "antipodal"
    """`antipodal` samples pairs of contacts; `graspgen` asks a server at `grasp_url`."""
    grasp_url: ModelUrl = ""
    """Base URL of the grasp server, without `/grasps`. https but on localhost."""
    grasp_gripper: ModelName = "franka_panda"
    """Name of the gripper on the grasp server."""
    grasp_depth_m: Annotated[float, Field(ge=0.0, le=1.0)] = 0.1034
    """From the origin of the grasp server's gripper frame along its approach to between the fingertips [m]."""
    grasp_timeout_s: Positive = 30.0
    """Time limit of one answer of the grasp server with all retries; less than `task_deadline_s` [s]."""
    planner: Literal["rrt", "curobo"] = "rrt"
    """`rrt` runs anywhere; `curobo` needs a GPU and its package, and is experimental: it has never been run on one."""
    candidates: Annotated[int, Field(ge=16, le=100_000)] = 2000
    """Surface points from which grasps are sampled, per object."""
    gamma_strict: Annotated[float, Field(ge=-1.0, lt=0.0)] = -0.9
    """Stage 1 takes grasps whose approach's vertical component is at most this (paper, section 3.4)."""
    epsilon_m: Metres = 0.01
    """Least gap between the boxes of the placed object and of those around it (paper, section 3.4) [m]."""
    delta_margin_m: Metres = 0.02
    """Least gap along the axis of a side relation (paper, appendix D) [m]."""
    placements: Annotated[int, Field(ge=1, le=1000)] = 24
    """Placements that are kept per task, from at most a hundred times as many samples."""
    tries: Annotated[int, Field(ge=1, le=1000)] = 12
    """Pairs of grasp and placement that are planned before a task fails."""
    step_s: Annotated[float, Field(ge=0.004, le=0.1)] = 0.02
    """Time between the samples of a motion, which are also the commands [s]."""
    speed: Annotated[float, Field(gt=0.0, le=1.0)] = 0.5
    """Share of the arm's velocity and acceleration limits that motions use."""
    max_disturbed_m: Positive = 0.02
    """A trajectory fails where any other object was displaced by more [m]."""
    task_deadline_s: Positive = 60.0
    """Wall time of one task, planning and verification; a hang or crash loses that task alone [s]."""
    max_tasks: Annotated[int, Field(ge=0, le=100)] = 100
    """Accepted tasks of a scene that are tried, in their order."""

    @property
    def _extra_s(self) -> float:
        return self.max_tasks * self.task_deadline_s

    @model_validator(mode="after")
    def _check_grasp_server(self) -> "TrajectoriesConfig":
        if self.grasp_model != "graspgen":
            return self
        if not self.grasp_url or not self.grasp_gripper:
            raise ValueError("the grasp model 'graspgen' needs trajectories.grasp_url and trajectories.grasp_gripper")
        if self.grasp_timeout_s >= self.task_deadline_s:
            raise ValueError(
                f"trajectories.grasp_timeout_s ({self.grasp_timeout_s:g}) must be less than "
                f"trajectories.task_deadline_s ({self.task_deadline_s:g}): a task would end while the server is asked"
            )
        return self


class RunConfig(Section):
    """Seed, shards, retries and limits of the run."""

    seed: Annotated[int, Field(ge=0)] = 0
    """Seed of everything random; the same seed gives the same bytes."""
    shard_size: Annotated[int, Field(ge=1, le=10_000)] = 64
    """Scenes per shard, which is written and recomputed as a whole."""
    attempts: Annotated[int, Field(ge=1, le=10)] = 2
    """Attempts of a stage that crashes, hangs or runs out of memory on a scene; errors are final."""
    deadline_s: Positive = 300.0
    """Wall time of one stage on one scene, unless its own section sets it [s]."""
    memory_mb: Annotated[int, Field(ge=256, le=4_194_304)] = 6144
    """Limit on the resident memory of the process that runs a stage [MB]."""


class Config(Section):
    """Everything that decides the bytes of a dataset, besides its input."""

    run: RunConfig = RunConfig()
    observe: ObserveConfig = ObserveConfig()
    perceive: PerceiveConfig = PerceiveConfig()
    place: PlaceConfig = PlaceConfig()
    rectify: RectifyConfig = RectifyConfig()
    settle: SettleConfig = SettleConfig()
    curate: CurateConfig = CurateConfig()
    export: ExportConfig = ExportConfig()
    trajectories: TrajectoriesConfig = TrajectoriesConfig()
    models: ModelsConfig = ModelsConfig()
    asking: AskingConfig = AskingConfig()

    def get_deadline(self, section: str) -> float:
        """Get the wall time of the stage of a section [s]."""
        own: StageSection = getattr(self, section)
        return own.resolve_deadline(self.run.deadline_s)

    @model_validator(mode="after")
    def _check_timeouts(self) -> "Config":
        for section in ("perceive", "curate"):
            own: RemoteModelSection = getattr(self, section)
            deadline_s = self.get_deadline(section)
            if own.protocol and own.timeout_s >= deadline_s:
                raise ValueError(
                    f"{section}.timeout_s ({own.timeout_s:g}) must be less than the stage's deadline "
                    f"({deadline_s:g}, of {section}.deadline_s or run.deadline_s): it would be killed while its model "
                    "is asked"
                )
        return self
