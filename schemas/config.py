"""The whole configuration, a section per stage. Every key has a default and a meaning; unknown keys are errors."""

import os
import re
from abc import abstractmethod
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from schemas.address import ModelUrl

Metres = Annotated[float, Field(ge=0.0, le=100.0, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


def _variable_name(name: str) -> str:
    """The name of an environment variable; the message does not show it, for it may be a key that went astray."""
    if name and not re.fullmatch(r"[A-Z_][A-Z0-9_]{0,63}", name):
        raise ValueError("must be the NAME of an environment variable, in capitals; never the key itself")
    return name


MODEL_LOAD_S = 1200.0
"""Wall time in which a model fetches and loads its weights, and its process starts [s]."""
MAX_SLOW_MESHES = 30
"""Objects of a scene that may each take as long as `place.mesh_timeout_s`; as a rule one takes a fraction of it."""

KeyVariable = Annotated[str, Field(max_length=4096), AfterValidator(_variable_name)]
Weights = Annotated[str, Field(max_length=4096), AfterValidator(os.path.expanduser)]
ModelName = Annotated[str, Field(max_length=200, pattern=r"^[A-Za-z0-9._:/@+-]*$")]


class Section(BaseModel):
    """Base of the sections."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


class StageSection(Section):
    """Base of the sections that belong to a stage."""

    deadline_s: Positive | None = None
    """Wall time of this stage on one scene; null for `run.deadline_s` [s]."""

    def resolve_deadline(self, run_deadline_s: float) -> float:
        """The wall time of the stage, where that of the run is this [s]."""
        return run_deadline_s if self.deadline_s is None else self.deadline_s


class RemoteModelSection(StageSection):
    """Base of the sections whose stage may ask a model behind an address."""

    base_url: ModelUrl = ""
    """Of `openai`, e.g. `http://localhost:8000/v1`; `gemini` has its public one. https but on localhost."""
    model: ModelName = ""
    """What the server calls the model."""
    key_env: KeyVariable = ""
    """Name of the environment variable that holds the key; empty for a server that wants none."""
    enforce_schema: bool = True
    """Whether the answer's schema is sent for the server to enforce; false for servers that refuse it."""
    timeout_s: Positive = 240.0
    """For one answer of a model with all retries; less than the stage's deadline [s]."""
    usd_per_million_input: Annotated[float, Field(ge=0.0, le=1e6, allow_inf_nan=False)] = 0.0
    """Price of a million tokens of the question [USD]."""
    usd_per_million_output: Annotated[float, Field(ge=0.0, le=1e6, allow_inf_nan=False)] = 0.0
    """Price of a million tokens of the answer [USD]."""

    @property
    @abstractmethod
    def protocol(self) -> str:
        """Which protocol is spoken with the model, `openai` or `gemini`; empty where none is asked."""

    def find_missing_keys(self) -> list[str]:
        """Keys without which the model cannot be asked."""
        missing = {
            "model": bool(self.protocol) and not self.model,
            "base_url": self.protocol == "openai" and not self.base_url,
            "key_env": self.protocol == "gemini" and not self.key_env,
        }
        return [name for name, is_missing in missing.items() if is_missing]


class AskingConfig(Section):
    """How models behind an address are asked, on each machine. Nothing here changes what they answer."""

    max_parallel: Annotated[int, Field(ge=1, le=1024)] = 8
    """Questions under way at a time."""
    per_minute: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """Questions begun within a minute; 0 for no limit."""


class ModelsConfig(Section):
    """Where models with weights of their own run."""

    device: Literal["auto", "cpu", "cuda"] = "auto"
    """`auto` is the GPU where there is one that torch can use. The same scene differs in a few pixels between them."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """`auto` is bfloat16 on a GPU and float32 on a CPU."""


class ObserveConfig(StageSection):
    """Bounds on what is decoded, and the depth used beyond which nothing is believed."""

    max_pixels: Annotated[int, Field(ge=1, le=200_000_000)] = 40_000_000
    """Of one picture, by its header; a larger one is refused before it is decoded."""
    max_file_bytes: Annotated[int, Field(ge=1)] = 256 * 1024 * 1024
    """Of one file of the input [bytes]."""
    max_depth_m: Positive = 5.0
    """Depth beyond this is not believed [m]."""
    depth: Literal[
        "sensor", "recorded", "depth_anything_3", "depth_anything_3_nested", "moge_2", "depth_anything_2"
    ] = "sensor"
    """Where the depth of a bare picture comes from; `sensor` has none for it, `recorded` reads `NAME.depth.npy` and
    `NAME.camera.json` beside it. A capture always has its own."""
    depth_weights: Weights = ""
    """Folder, or `owner/name` or `owner/name@revision` on the hub, of the depth model; empty for the published ones."""
    focal_px: Annotated[float, Field(gt=0.0, le=1e6, allow_inf_nan=False)] | None = None
    """Focal length of bare pictures, for models that do not tell it, where their EXIF does not either [px]."""

    def resolve_deadline(self, run_deadline_s: float) -> float:
        """A depth model may load its weights besides."""
        if self.deadline_s is not None or self.depth in ("sensor", "recorded"):
            return super().resolve_deadline(run_deadline_s)
        return run_deadline_s + MODEL_LOAD_S


class PerceiveConfig(RemoteModelSection):
    """Which backend finds the objects, and how the table is found."""

    detector: Literal["auto", "geometric", "learned", "replay", "openai", "gemini"] = "auto"
    """`auto` replays `detections.json` where the capture has one, with `masks.png` if it is there; else `geometric`.
    `learned` is a net of `tableverse train segmenter`, `openai` any server of OpenAI's chat completions, `gemini`
    Google's own protocol."""
    detector_weights: Weights = ""
    """The `.onnx` file of `learned`."""
    box_order: Literal["auto", "xyxy", "yxyx"] = "auto"
    """In which order the model gives boxes; `auto` is yxyx for `gemini`, else xyxy."""
    segmenter: Literal["geometric", "sam2", "sam3"] = "geometric"
    """What turns boxes into masks: our own from depth, or a model with weights, for detectors that give boxes: `replay`
    without `masks.png`, `openai`, `gemini`."""
    segmenter_weights: Weights = ""
    """Folder, or `owner/name` or `owner/name@revision` on the hub, of the segmenter; empty for the published ones."""
    segmenter_batch: Annotated[int, Field(ge=1, le=256)] = 8
    """Pictures that go through the segmenter at a time on a GPU."""
    max_objects: Annotated[int, Field(ge=1, le=200)] = 60
    """Most objects that are kept of one picture."""

    @property
    def protocol(self) -> str:
        """Which protocol is spoken with the detector; empty where none is asked."""
        return self.detector if self.detector in ("openai", "gemini") else ""

    def resolve_deadline(self, run_deadline_s: float) -> float:
        """A segmenter may load its weights besides."""
        if self.deadline_s is not None or self.segmenter == "geometric":
            return super().resolve_deadline(run_deadline_s)
        return run_deadline_s + MODEL_LOAD_S

    @model_validator(mode="after")
    def _complete(self) -> "PerceiveConfig":
        names = [f"perceive.{name}" for name in self.find_missing_keys()]
        if self.detector == "learned" and not self.detector_weights:
            names.append("perceive.detector_weights")
        if names:
            raise ValueError(f"the detector {self.detector!r} needs {' and '.join(names)}")
        if self.detector in ("auto", "geometric", "learned") and self.segmenter != "geometric":
            where = " where a capture has no detections.json" if self.detector == "auto" else ""
            raise ValueError(
                f"the detector {self.detector!r} gives masks, not boxes{where}, so perceive.segmenter "
                f"{self.segmenter!r} would do nothing: set perceive.detector to 'replay' (the boxes of "
                "detections.json), 'openai' or 'gemini', or leave the segmenter 'geometric'"
            )
        return self


class PlaceConfig(StageSection):
    """How meshes are completed and registered."""

    mesh_model: Literal["carved", "replay", "sam3d", "triposr"] = "carved"
    """`carved` completes what the picture shows; `replay` registers the meshes recorded in `meshes/` of the capture;
    `sam3d` and `triposr` are models in a process of their own."""
    mesh_command: Annotated[tuple[Annotated[str, Field(max_length=4096)], ...], Field(max_length=64)] = ()
    """Program and arguments that start the process of the mesh model."""
    mesh_timeout_s: Positive = 120.0
    """For one object's mesh: the longest silence of that process [s]."""

    def resolve_deadline(self, run_deadline_s: float) -> float:
        """A mesh model may load its weights, and then take its own time for each object."""
        if self.deadline_s is not None or not self.in_process:
            return super().resolve_deadline(run_deadline_s)
        return run_deadline_s + MODEL_LOAD_S + MAX_SLOW_MESHES * self.mesh_timeout_s

    @property
    def in_process(self) -> bool:
        """Whether meshes come from a model in a process of its own."""
        return self.mesh_model in ("sam3d", "triposr")

    @model_validator(mode="after")
    def _complete(self) -> "PlaceConfig":
        if self.in_process and not self.mesh_command:
            raise ValueError(f"the mesh model {self.mesh_model!r} needs place.mesh_command (docs/mesh-process.md)")
        return self


class RectifyConfig(StageSection):
    """Convex pieces and the ways to move objects apart."""

    method: Literal["joint", "lccr"] = "joint"
    """`joint` moves the whole layout least and keeps who carries whom (docs/concepts.md); `lccr` is the paper's."""
    clearance_m: Metres = 0.0005
    """Gap that is left between objects, on top of what their meshes stick out of their pieces [m]."""
    contact_m: Metres = 0.01
    """Objects with a gap of at most this between them count as touching: about the noise of registration [m]."""
    overlap_ratio: Annotated[float, Field(gt=0.0, le=1.0)] = 0.5
    """`lccr`: touching objects whose boxes, seen from above, share this much of the smaller's area are one group."""
    decomposition: Literal["cut", "coacd"] = "cut"
    """How meshes become convex pieces: our own cuts and merges, or CoACD as in the paper (docs/benchmarks.md)."""
    volume_error: Annotated[float, Field(gt=0.0, le=10.0)] = 0.1
    """Pieces may add up to this share of a mesh's volume, if `max_pieces` allows."""
    max_pieces: Annotated[int, Field(ge=1, le=256)] = 48
    """Convex pieces per object."""
    max_contents: Annotated[int, Field(ge=0, le=200)] = 60
    """Things in the containers of one scene, counted copies included; what is beyond is left out."""
    fall_time_s: Annotated[float, Field(ge=1.0, le=20.0)] = 3.0
    """Simulated time within which a thing dropped into a container must come to rest [s]."""


class SettleConfig(StageSection):
    """The forward simulation to rest."""

    timestep_s: Annotated[float, Field(ge=0.0002, le=0.005)] = 0.002
    """Step of the simulation, also written into the exported XML [s]."""
    max_time_s: Annotated[float, Field(ge=0.5, le=60.0)] = 6.0
    """Simulated time within which a scene must come to rest; restless objects get it a second time [s]."""


class CurateConfig(RemoteModelSection):
    """The judge."""

    judge: Literal["rules", "openai", "gemini", "replay"] = "rules"
    """`rules` needs no model; `openai` is any server of OpenAI's chat completions, `gemini` Google's own protocol."""
    replay_dir: Annotated[str, Field(max_length=4096)] = ""
    """Folder of recorded answers for the judge `replay`: `<scene_id>.json` each. Its content is part of the run."""
    max_tasks: Annotated[int, Field(ge=0, le=100)] = 20
    """Most tasks that the rules make for a scene."""
    gripper_width_m: Positive = 0.078
    """Widest opening of the gripper that tasks are meant for [m]."""
    max_grasp_mass_kg: Positive = 2.0
    """What that gripper lifts [kg]."""

    @property
    def protocol(self) -> str:
        """Which protocol is spoken with the judge; empty where none is asked."""
        return self.judge if self.judge in ("openai", "gemini") else ""

    @model_validator(mode="after")
    def _complete(self) -> "CurateConfig":
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
    """Of `observation/color.jpg`, which the textures are made from too."""


class TrajectoriesConfig(StageSection):
    """Grasps, placements and motions for the accepted tasks of a scene, each proven in simulation."""

    deadline_s: Positive | None = None
    """Wall time of all tasks of one scene; null for `run.deadline_s` and `task_deadline_s` for each of `max_tasks`."""
    robot: Annotated[str, Field(min_length=1, max_length=4096)] = "panda"
    """`panda` is our own; `menagerie:NAME` comes from the package mujoco-menagerie; else a file `….xml` of an arm."""
    grasp_model: Literal["antipodal", "graspgen"] = "antipodal"
    """`antipodal` samples pairs of contacts; `graspgen` asks a server at `grasp_url`."""
    grasp_url: ModelUrl = ""
    """Of the grasp server, up to and without `/grasps`. https but on localhost."""
    grasp_gripper: ModelName = "franka_panda"
    """What the grasp server calls the gripper."""
    grasp_depth_m: Annotated[float, Field(ge=0.0, le=1.0)] = 0.1034
    """From the origin of the grasp server's gripper frame along its approach to between the fingertips [m]."""
    grasp_timeout_s: Positive = 30.0
    """For one answer of the grasp server with all retries; less than `task_deadline_s` [s]."""
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
    """Pairs of grasp and placement that are planned before a task is given up."""
    step_s: Annotated[float, Field(ge=0.004, le=0.1)] = 0.02
    """Time between the samples of a motion, which are also the commands [s]."""
    speed: Annotated[float, Field(gt=0.0, le=1.0)] = 0.5
    """Share of the arm's velocity and acceleration limits that motions use."""
    max_disturbed_m: Positive = 0.02
    """A trajectory fails where any other object was displaced by more [m]."""
    task_deadline_s: Positive = 60.0
    """Wall time of one task, planning and proof; what hangs or crashes costs that task alone [s]."""
    max_tasks: Annotated[int, Field(ge=0, le=100)] = 100
    """Accepted tasks of a scene that are tried, in their order."""

    def resolve_deadline(self, run_deadline_s: float) -> float:
        """Every task may take its own time, so the stage's is only for what no task is to blame for [s]."""
        return run_deadline_s + self.max_tasks * self.task_deadline_s if self.deadline_s is None else self.deadline_s

    @model_validator(mode="after")
    def _asks_in_time(self) -> "TrajectoriesConfig":
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
    """The run as a whole."""

    seed: Annotated[int, Field(ge=0)] = 0
    """Of everything that is drawn at random; the same seed gives the same bytes."""
    shard_size: Annotated[int, Field(ge=1, le=10_000)] = 64
    """Scenes in one shard: what is written, and done again, as one."""
    attempts: Annotated[int, Field(ge=1, le=10)] = 2
    """How often a stage may crash, hang or run out of memory on a scene before it is failed; errors are final."""
    deadline_s: Positive = 300.0
    """Wall time of one stage on one scene, where its own section names none [s]."""
    memory_mb: Annotated[int, Field(ge=256)] = 6144
    """Resident memory of the process that runs a stage [MB]; beyond it the scene is out of memory."""


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
        """Wall time of the stage that this section belongs to [s]."""
        its: StageSection = getattr(self, section)
        return its.resolve_deadline(self.run.deadline_s)

    @model_validator(mode="after")
    def _in_time(self) -> "Config":
        for section in ("perceive", "curate"):
            its: RemoteModelSection = getattr(self, section)
            deadline_s = self.get_deadline(section)
            if its.protocol and its.timeout_s >= deadline_s:
                raise ValueError(
                    f"{section}.timeout_s ({its.timeout_s:g}) must be less than the stage's deadline "
                    f"({deadline_s:g}, of {section}.deadline_s or run.deadline_s): it would be killed while its model "
                    "is asked"
                )
        return self
