"""Samples of a training: goals and chunks of demonstrations, augmented."""

from dataclasses import dataclass

from tableverse_factory.evaluation.training.policy.demonstrations import STEP_S
from tableverse_factory.evaluation.training.policy.goals import (
    DRAWN_POINTS,
    Scenes,
    describe_grasp,
    describe_task,
    encode_grasp,
    encode_release,
    find_frame,
    select_points,
)
from tableverse_factory.evaluation.training.policy.motions import (
    MOTION_POINTS,
    RobotState,
    describe_state,
    encode_chunk,
    localize_points,
)
from tableverse_factory.evaluation.training.policy.network import CHUNK
from tableverse_factory.evaluation.training.policy.rotations import apply, matrix_from_vector
from tableverse_factory.evaluation.training.policy.tensors import (
    GRASP,
    PLACE,
    POST_GRASP,
    DemonstrationTensors,
)
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()

TURN_RAD = 0.25  # deviation of the frames of goals
JITTER_M = 0.0007  # of the points
CLOCK_S = 0.06  # noise of the time since a phase began
MEASURED_M = 0.0005  # noise of the measured opening
LOST = 0.15  # share of other objects that are left out
RETURN = 6  # samples within which a disturbed motion is back on its path
BLIND = 0.2  # share of states that are told of no object, as those of a policy on pictures are
LATE = 0.15  # share of states whose phase is told late, by up to LATE_STEPS
LATE_STEPS = 3


@dataclass(frozen=True, slots=True)
class GoalBatch:
    """Scenes with a goal each."""

    points: Tensor
    roles: Tensor
    mask: Tensor
    task: Tensor
    goal: Tensor  # (b, GOAL)
    release: Tensor  # whether it is a release, else a grasp


@dataclass(frozen=True, slots=True)
class ChunkBatch:
    """States with the next samples."""

    state: Tensor
    points: Tensor
    mask: Tensor
    chunk: Tensor  # (b, CHUNK, 7)
    phases: Tensor  # (b, CHUNK)
    left: Tensor  # distance to the goal [m], (b, CHUNK)


def _draw_mirror(count: int, like: Tensor, augment: bool) -> Tensor:
    return (torch.rand(count, device=like.device) < 0.5) & augment


def draw_rows(choices: Tensor, count: int) -> Tensor:
    """Draw with replacement. Shape (count,)."""
    return choices[torch.randint(len(choices), (count,), device=choices.device)]


def sample_goals(
    data: DemonstrationTensors, demos: Tensor, release: Tensor, augment: bool, seen: tuple[Tensor, Tensor] | None = None
) -> GoalBatch:
    """Sample the goal of each demonstration: its release, or its grasp. Both of shape (b,).

    `seen` are the points that are told of the scene and the rows that are there; those of all objects by default.
    """
    points, present = data.place_points(demos, DRAWN_POINTS) if seen is None else seen
    if augment:
        points = points + JITTER_M * torch.randn_like(points)
        kept = torch.rand(present.shape, device=present.device) > LOST
        kept[:, :2] = True
        present = present & kept
    base = data.base_at[demos], data.base_turn[demos]
    scenes = Scenes(points, present, *base, data.kind[demos], data.side[demos])
    turn = TURN_RAD * torch.randn(len(demos), device=points.device) * augment
    mirror = _draw_mirror(len(demos), points, augment)
    frame = find_frame(scenes, release, turn, mirror)
    grasp_at, grasp_turn = data.grasp_at[demos], data.grasp_turn[demos]
    opening, holding = data.openings[demos], data.holding[demos]
    grasp = encode_grasp(scenes, frame, grasp_at, grasp_turn, opening[:, 0], holding)
    motion = data.place_turn[demos] @ grasp_turn.mT
    middle = apply(motion, scenes.middle[:, 0] - grasp_at) + data.place_at[demos]
    goal = torch.where(release[:, None], encode_release(frame, middle, motion, opening[:, 1], holding), grasp)
    held = describe_grasp(scenes, frame, grasp_at, grasp_turn)
    return GoalBatch(*select_points(scenes, frame), describe_task(scenes, frame, release, held), goal, release)


def sample_chunks(data: DemonstrationTensors, now: Tensor, augment: bool) -> ChunkBatch:
    """Sample the chunks that follow samples `now`, (b,), disturbed from their paths where `augment`."""
    demos = data.owner[now]
    steps = now[:, None] + torch.arange(1, CHUNK + 1, device=now.device)
    steps = torch.minimum(steps, data.last[demos][:, None])
    phase = data.phases[now]
    told = now
    if augment:
        late = (torch.rand(len(now), device=now.device) < LATE) * torch.randint(
            1, LATE_STEPS + 1, now.shape, device=now.device
        )
        told = torch.maximum(now - late, data.first[demos])
    stage = data.phases[told]
    grasping = (stage <= GRASP)[:, None]
    goal_at = torch.where(grasping, data.grasp_at[demos], data.place_at[demos])
    goal_turn = torch.where(grasping[..., None], data.grasp_turn[demos], data.place_turn[demos])
    opening = torch.where(grasping[:, 0], data.openings[demos, 0], data.openings[demos, 1])
    tcp_at, tcp_turn = data.tcp_at[now], data.tcp_turn[now]
    next_at, next_turn = data.tcp_at[steps], data.tcp_turn[steps]
    carried_at, measured = data.carried_at[now], data.opening[now]
    since = STEP_S * (now - data.phase_start[told]).float()
    if augment:
        since = (since + CLOCK_S * torch.randn_like(since)).clamp(min=0.0)
        shift, turn = _draw_disturbance(data, demos, tcp_at)
        fade = (1.0 - torch.arange(1, CHUNK + 1, device=now.device) / RETURN).clamp(min=0.0)[:, None]
        tcp_at, tcp_turn = tcp_at + shift, matrix_from_vector(turn) @ tcp_turn
        next_at = next_at + fade * shift[:, None]
        next_turn = matrix_from_vector(fade * turn[:, None]) @ next_turn
        held = ((phase >= POST_GRASP) & (phase <= PLACE))[:, None]
        carried_at = carried_at + shift * held
        noise = MEASURED_M * torch.randn_like(measured[:, 1])
        measured = torch.stack([measured[:, 0], measured[:, 1] + noise], 1)
    fingers = torch.stack([opening, data.holding[demos]], 1)
    moved = torch.where(grasping, 0.0, tcp_at - data.grasp_at[demos])
    state = RobotState(
        tcp_at,
        tcp_turn,
        measured,
        goal_at,
        goal_turn,
        fingers,
        stage,
        moved,
        since,
        data.base_at[demos],
        data.base_turn[demos],
    )
    mirror = torch.ones_like(tcp_at)
    mirror[:, 1] = torch.where(_draw_mirror(len(now), tcp_at, augment), -1.0, 1.0)
    chunk, left = encode_chunk(state, next_at, next_turn, data.opening[steps, 0], mirror)
    points, present = data.place_points(demos, MOTION_POINTS)
    points = _carry_points(data, demos, points, carried_at, data.carried_turn[now])
    points = localize_points(points, goal_at, goal_turn, mirror)
    if augment:
        present = present & (torch.rand(len(now), 1, device=now.device) > BLIND)
    return ChunkBatch(describe_state(state, mirror), points, present, chunk, data.phases[steps], left)


def _draw_disturbance(data: DemonstrationTensors, demos: Tensor, tcp_at: Tensor) -> tuple[Tensor, Tensor]:
    """Draw displacements [m] and turns [rad] of the gripper, small near the grasp and the release. Shape (b, 3)."""
    near = torch.minimum((tcp_at - data.grasp_at[demos]).norm(dim=1), (tcp_at - data.place_at[demos]).norm(dim=1))
    near = near.clamp(max=0.3)[:, None] * (torch.rand(len(demos), 1, device=tcp_at.device) < 0.7)
    shift = (0.0015 + 0.06 * near) * torch.randn_like(tcp_at)
    return shift, (0.01 + 0.15 * near) * torch.randn_like(tcp_at)


def _carry_points(data: DemonstrationTensors, demos: Tensor, points: Tensor, at: Tensor, turn: Tensor) -> Tensor:
    """Move X's points from where it stood to where it is now."""
    own = data.objects[demos, 0]
    stood = points[:, 0] - data.object_at[own][:, None]
    local = apply(data.object_turn[own].mT[:, None], stood)
    carried = apply(turn[:, None], local) + at[:, None]
    return torch.cat([carried[:, None], points[:, 1:]], 1)


def draw_goals(data: DemonstrationTensors, count: int, held_out: bool, augment: bool) -> GoalBatch:
    """Draw goals of random demonstrations."""
    demos = draw_rows(data.choices[held_out][0], count)
    release = torch.rand(count, device=demos.device) < 0.5
    return sample_goals(data, demos, release, augment)


def draw_chunks(data: DemonstrationTensors, count: int, held_out: bool, augment: bool) -> ChunkBatch:
    """Draw chunks after random samples."""
    return sample_chunks(data, draw_rows(data.choices[held_out][1], count), augment)
