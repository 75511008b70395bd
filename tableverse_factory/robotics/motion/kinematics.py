"""Batched forward and inverse kinematics of serial arms.

A chain is read off a compiled model and then evaluated with numpy alone, for many configurations at once: a batch of
sixteen costs little more than one. The inverse is damped least squares (Levenberg-Marquardt with damping that shrinks
with the error, Sugihara 2011) from fixed restarts, so that it draws no random numbers. Frames: the robot's base.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float64, Int64

from schemas.geometry import Frozen, Matrix4, Pose, Vector3
from schemas.trajectories import JointVector
from tableverse_factory.geometry.math.transforms import matrix_from_pose
from tableverse_factory.robotics.robots.arm import list_bodies_between

Configurations = Float64[np.ndarray, "b j"]
Rotations = Float64[np.ndarray, "b 3 3"]
Positions = Float64[np.ndarray, "b 3"]
POSITION_TOLERANCE_M, ROTATION_TOLERANCE_RAD = 1e-6, 1e-5
# Distance of solutions from joint limits, so that a servo that overshoots does not run into its stop
LIMIT_MARGIN_RAD = 0.02
MAX_ITERATIONS, LINE_ITERATIONS = 40, 8
MAX_STEP_RAD = 0.6
RESTARTS = 24
DISTINCT_RAD = 0.25  # solutions whose joints all differ by less are duplicates
MAX_JUMP_RAD = 0.25  # largest motion of a joint between neighboring poses of a line; a larger one is a change of branch
_ROTATION_WEIGHT_M = 0.3  # A radian of error weighs as much as this many meters, about the lever over which it acts


@dataclass(frozen=True, slots=True, eq=False)
class KinematicChain(Frozen):
    """Serial arm of hinges [rad] and slides [m] from its base to the TCP."""

    offsets: Float64[np.ndarray, "j 4 4"]  # from the frame after joint i-1 to the frame of joint i at rest [m]
    axes: Float64[np.ndarray, "j 3"]  # of each joint in its own frame
    hinges: Bool[np.ndarray, " j"]  # whether a joint turns; the others slide
    references: JointVector  # joint values of the model's reference configuration
    lower: JointVector
    upper: JointVector
    tip: Matrix4  # from the frame after the last joint to the TCP
    turns: Float64[np.ndarray, "3 j 3 3"]  # factors of 1, sin and 1 - cos in each joint's rotation matrix

    def forward(self, q: Configurations) -> tuple[Rotations, Positions]:
        """Compute orientation and position of the TCP. Shapes (b, 3, 3) and (b, 3) [m]."""
        rotation, position, _, _ = self._frames(q)
        return rotation, position

    def pose_matrix(self, q: JointVector) -> Matrix4:
        """Compute the TCP in the base frame. Shape (4, 4)."""
        rotation, position = self.forward(q[None])
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation[0], position[0]
        return matrix

    def _frames(
        self, q: Configurations
    ) -> tuple[Rotations, Positions, Float64[np.ndarray, "b j 3"], Float64[np.ndarray, "b j 3"]]:
        """Compute the TCP, and each joint's axis and anchor in the base frame."""
        moved = q - self.references
        angle = np.where(self.hinges, moved, 0.0)[:, :, None, None]
        local = self.turns[0] + np.sin(angle) * self.turns[1] + (1 - np.cos(angle)) * self.turns[2]
        slid = np.where(self.hinges, 0.0, moved)
        rotation, position = np.broadcast_to(np.eye(3), (len(q), 3, 3)), np.zeros((len(q), 3))
        axes, anchors = np.empty((len(q), len(self.axes), 3)), np.empty((len(q), len(self.axes), 3))
        for j in range(len(self.axes)):
            position = position + rotation @ self.offsets[j, :3, 3]
            rotation = rotation @ local[:, j]
            axes[:, j] = rotation @ self.axes[j]
            anchors[:, j] = position
            if not self.hinges[j]:
                position = position + slid[:, j, None] * axes[:, j]
        position = position + rotation @ self.tip[:3, 3]
        return rotation @ self.tip[:3, :3], position, axes, anchors

    def step(
        self, q: Configurations, target: Matrix4, pull: Configurations
    ) -> tuple[Configurations, Bool[np.ndarray, " b"]]:
        """Take one damped step towards a TCP pose in the base frame; also return which configurations have arrived.

        `pull` is where joints go as far as the pose leaves them free. Shapes (b, j), (4, 4) and (b, j).
        """
        rotation, position, axes, anchors = self._frames(q)
        off = target[:3, 3] - position
        turn = _compute_rotation_vectors(target[:3, :3] @ rotation.transpose(0, 2, 1))
        there = (np.abs(off).max(axis=1) < POSITION_TOLERANCE_M) & (np.abs(turn).max(axis=1) < ROTATION_TOLERANCE_RAD)
        error = np.concatenate([off, _ROTATION_WEIGHT_M * turn], axis=1)
        jacobian = self._jacobian(position, axes, anchors)
        damping = 1e-10 + 0.01 * (error**2).sum(axis=1)
        normal = jacobian @ jacobian.transpose(0, 2, 1) + damping[:, None, None] * np.eye(6)
        free = (jacobian @ pull[:, :, None])[:, :, 0]
        solved = np.linalg.solve(normal, (error - free)[:, :, None])
        change = pull + (jacobian.transpose(0, 2, 1) @ solved)[:, :, 0]
        largest = np.abs(change).max(axis=1, keepdims=True)
        return change * np.minimum(1.0, MAX_STEP_RAD / np.maximum(largest, 1e-12)), there

    def _jacobian(
        self, tip: Positions, axes: Float64[np.ndarray, "b j 3"], anchors: Float64[np.ndarray, "b j 3"]
    ) -> Float64[np.ndarray, "b 6 j"]:
        arm = tip[:, None] - anchors
        jacobian = np.empty((len(tip), 6, len(self.axes)))
        for k, (m, n) in enumerate(((1, 2), (2, 0), (0, 1))):
            turning = axes[:, :, m] * arm[:, :, n] - axes[:, :, n] * arm[:, :, m]
            jacobian[:, k] = np.where(self.hinges, turning, axes[:, :, k])
            jacobian[:, 3 + k] = _ROTATION_WEIGHT_M * np.where(self.hinges, axes[:, :, k], 0.0)
        return jacobian


def build_chain(
    model: mujoco.MjModel,
    joint_names: tuple[str, ...],
    base_body: int,
    tcp_site: int,
    limits: tuple[JointVector, JointVector],
) -> KinematicChain:
    """Build the chain from a body to a site of a compiled model, through the named hinges or slides.

    `limits` are the arm's, as the model's ranges may exceed the actuators' [rad or m].
    """
    wanted = [model.joint(name).id for name in joint_names]
    offsets, found, pending = [], [], np.eye(4)
    for body in list_bodies_between(model, base_body, int(model.site_bodyid[tcp_site])):
        pending = pending @ _build_matrix(model.body_pos[body], model.body_quat[body])
        first = model.body_jntadr[body]
        for joint in range(first, first + model.body_jntnum[body]):
            if joint in wanted:
                anchor = _build_matrix(model.jnt_pos[joint], np.array([1.0, 0.0, 0.0, 0.0]))
                offsets.append(pending @ anchor)
                pending = np.linalg.inv(anchor)
                found.append(joint)
    if found != wanted:
        raise ValueError(f"the joints {joint_names} do not lead, in this order, from the arm's base to its TCP")
    tip = pending @ _build_matrix(model.site_pos[tcp_site], model.site_quat[tcp_site])
    return _assemble_chain(model, np.array(found), np.array(offsets), tip, limits)


def _assemble_chain(
    model: mujoco.MjModel,
    joints: np.ndarray,
    offsets: np.ndarray,
    tip: Matrix4,
    limits: tuple[JointVector, JointVector],
) -> KinematicChain:
    axes = np.array(model.jnt_axis[joints], dtype=np.float64)
    skew = np.zeros((len(joints), 3, 3))
    skew[:, 0, 1], skew[:, 0, 2], skew[:, 1, 2] = -axes[:, 2], axes[:, 1], -axes[:, 0]
    skew = skew - skew.transpose(0, 2, 1)
    at_rest = offsets[:, :3, :3]
    return KinematicChain(
        offsets=offsets,
        axes=axes,
        hinges=model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_HINGE,
        references=np.array(model.qpos0[model.jnt_qposadr[joints]]),
        lower=np.array(limits[0], dtype=np.float64),
        upper=np.array(limits[1], dtype=np.float64),
        tip=tip,
        turns=np.array([at_rest, at_rest @ skew, at_rest @ skew @ skew]),
    )


def solve_ik(chain: KinematicChain, tcp_in_base: Pose, near: JointVector, count: int) -> Configurations:
    """Find up to `count` distinct configurations within limits that reach a pose, best first. Shape (n, j) [rad].

    Solutions are ranked by closeness to `near`, which is also the first seed, and by distance from the limits.
    """
    target = matrix_from_pose(tcp_in_base)
    lower, upper = chain.lower + LIMIT_MARGIN_RAD, chain.upper - LIMIT_MARGIN_RAD
    q = np.concatenate([np.clip(near, lower, upper)[None], _generate_restarts(lower, upper)])
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    done: list[JointVector] = []
    for iteration in range(MAX_ITERATIONS):
        pull = (0.1 if iteration < MAX_ITERATIONS // 4 else 0.0) * (near - q)
        change, there = chain.step(q, target, pull)
        done.extend(q[there])
        if there.all() or len(done) >= 3 * count:
            break
        q = np.clip(q[~there] + change[~there], lower, upper)
    if not done:
        return np.empty((0, len(near)))
    found = np.array(done)
    closeness = (((found - middle) / half) ** 4).sum(axis=1)
    ranked = found[np.argsort(((found - near) ** 2).sum(axis=1) + closeness, kind="stable")]
    return _drop_duplicates(ranked)[:count]


def follow_poses(
    chain: KinematicChain, start: Configurations, tcp_in_base: Sequence[Pose]
) -> tuple[Float64[np.ndarray, "n b j"], Int64[np.ndarray, " b"]]:
    """Track a sequence of poses, a few millimeters apart, from configurations at the pose before the first.

    Also returns how many poses each of the b configurations reached within the limits and without a jump.
    """
    lower, upper = chain.lower + LIMIT_MARGIN_RAD / 2, chain.upper - LIMIT_MARGIN_RAD / 2
    rows = np.empty((len(tcp_in_base), *start.shape))
    reached, q, before = np.full(len(start), len(tcp_in_base)), np.array(start), np.array(start)
    still = np.zeros_like(q)
    for index, pose in enumerate(tcp_in_base):
        target, there = matrix_from_pose(pose), np.zeros(len(q), dtype=bool)
        q, before = np.clip(2 * q - before, lower, upper), q  # on with the same motion: one step less to the next pose
        lost = reached <= index
        for _ in range(LINE_ITERATIONS):
            change, there = chain.step(q, target, still)
            if (there | lost).all():
                break
            q = np.clip(q + change, lower, upper)
        fell = ~lost & (~there | (np.abs(q - before).max(axis=1) > MAX_JUMP_RAD))
        reached[fell] = index
        rows[index] = q
        if (reached <= index).all():
            break
    return rows, reached


def _generate_restarts(lower: JointVector, upper: JointVector) -> Configurations:
    """Generate points of an additive recurrence: evenly spread and deterministic."""
    ratio = 2.0
    for _ in range(64):
        ratio = (1 + ratio) ** (1 / (len(lower) + 1))
    alphas = ratio ** -np.arange(1, len(lower) + 1)
    unit = (0.5 + np.arange(1, RESTARTS + 1)[:, None] * alphas) % 1.0
    return lower + (upper - lower) * (0.1 + 0.8 * unit)


def _drop_duplicates(ranked: Configurations) -> Configurations:
    kept = [ranked[0]]
    for q in ranked[1:]:
        if min(float(np.abs(q - other).max()) for other in kept) > DISTINCT_RAD:
            kept.append(q)
    return np.array(kept)


def _compute_rotation_vectors(rotations: Rotations) -> Positions:
    """Compute axis times angle of each rotation matrix. Shape (b, 3) [rad]."""
    m = rotations
    twice = np.stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], axis=1)
    sine = np.sqrt((twice**2).sum(axis=1)) / 2
    angle = np.arctan2(sine, (m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2] - 1) / 2)
    vectors: Positions = twice / 2 * (angle / np.maximum(sine, 1e-12))[:, None]
    return np.where(sine[:, None] < 1e-9, twice / 2, vectors)


def _build_matrix(position: Vector3, quaternion_wxyz: np.ndarray) -> Matrix4:
    return matrix_from_pose(Pose(np.array(position, dtype=np.float64), np.array(quaternion_wxyz, dtype=np.float64)))
