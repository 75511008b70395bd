"""Networks of the policy on states: where to grasp and to release, and how to move there.

`GoalNetwork` draws goals by flow matching (Lipman et al., 2023) over the points of the scene; `ChunkNetwork` computes
the next `CHUNK` poses of the gripper, their openings and phases, on the way to a goal.
"""

from typing import Any

from tableverse_factory.evaluation.training.policy.rotations import matrix_from_columns, vector_from_matrix
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()
nn, functional = torch.nn, torch.nn.functional
Module: Any = nn.Module

WIDTH, HEADS = 192, 6
ENCODER, DECODER, MOTION = 5, 3, 4  # layers
DROPOUT = 0.1
GOAL = 11  # position, two columns of the rotation, opening on the way there, opening that holds
QUERY = 24  # numbers that describe the task beside the points (`samples.GoalBatch`)
STATE = 44  # numbers of the robot's state (`samples.ChunkBatch`)
CHUNK = 16  # samples of `STEP_S`
PHASES = 6
STEP = 7 + PHASES  # of a chunk: position, rotation vector, opening, scores of the phases
GATES = 8  # of a chunk's step: shares of the position, of the rotation and of two openings that are left to go
LINEAR_M = 0.3  # scale of `expand_lengths` that is linear for the robot's state
POSITION_UNIT_M, OPENING_UNIT_M = 0.1, 0.08  # of chunks
ROLES = 3  # X, Y, others
FLOW_STEPS = 10


class Attention(Module):  # type: ignore[misc]
    """A layer of tokens that attend to a memory, or to one another, then a perceptron."""

    def __init__(self) -> None:
        super().__init__()
        self.before, self.between = nn.LayerNorm(WIDTH), nn.LayerNorm(WIDTH)
        self.ask, self.tell, self.join = nn.Linear(WIDTH, WIDTH), nn.Linear(WIDTH, 2 * WIDTH), nn.Linear(WIDTH, WIDTH)
        self.widen, self.narrow = nn.Linear(WIDTH, 3 * WIDTH), nn.Linear(3 * WIDTH, WIDTH)
        self.drop = nn.Dropout(DROPOUT)

    def forward(self, x: Tensor, mask: Tensor, memory: Tensor | None = None) -> Tensor:
        """Map tokens (b, n, c) to the same shape; `mask` (b, m) is true where the m tokens attended to are there."""
        batch, count, _ = x.shape
        normed = self.before(x)
        source = normed if memory is None else memory
        query = self.ask(normed).reshape(batch, count, HEADS, -1).transpose(1, 2)
        told = self.tell(source).reshape(batch, source.shape[1], 2, HEADS, -1).permute(2, 0, 3, 1, 4)
        heads = functional.scaled_dot_product_attention(query, told[0], told[1], attn_mask=mask[:, None, None])
        x = x + self.drop(self.join(heads.transpose(1, 2).reshape(batch, count, WIDTH)))
        return x + self.drop(self.narrow(functional.gelu(self.widen(self.between(x)))))


def make_perceptron(inputs: int, outputs: int) -> Any:
    """Make a perceptron of one hidden layer."""
    return nn.Sequential(nn.Linear(inputs, WIDTH), nn.GELU(), nn.Linear(WIDTH, outputs))


def expand_lengths(vectors: Tensor, scales: tuple[float, ...]) -> Tensor:
    """Show lengths [m] at several scales: linear in the largest, saturated in the others. Shape (…, k · scales)."""
    return torch.cat([vectors / scales[0], *(torch.tanh(vectors / scale) for scale in scales[1:])], -1)


class GoalNetwork(Module):  # type: ignore[misc]
    """Tokens of the points of a scene and of its task; a field that carries noise to goals."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = nn.ModuleList([Attention() for _ in range(ENCODER)])
        self.memory = nn.LayerNorm(WIDTH)
        self.noisy = make_perceptron(GOAL + 16, WIDTH)
        self.decoder = nn.ModuleList([Attention() for _ in range(DECODER)])
        self.flow = nn.Sequential(nn.LayerNorm(WIDTH), nn.Linear(WIDTH, GOAL))
        nn.init.zeros_(self.flow[1].weight)
        self.point = make_perceptron(3 * 4 + 3 * 2 + ROLES, WIDTH)
        self.task = make_perceptron(QUERY, WIDTH)

    def encode(self, points: Tensor, roles: Tensor, mask: Tensor, task: Tensor) -> tuple[Tensor, Tensor]:
        """Encode a scene once.

        Args:
            points: In the goal's frame, and from the middle of their object. Shape (b, n, 6) [m].
            roles: 0 for X, 1 for Y, 2 for others. Shape (n,).
            mask: Which points are there. Shape (b, n).
            task: Shape (b, QUERY).

        Returns:
            Tokens of shape (b, n + 1, c), and which of them are there.
        """
        at, own = points[..., :3], points[..., 3:]
        shown = torch.cat([expand_lengths(at, (0.3, 0.15, 0.05, 0.015)), expand_lengths(own, (0.1, 0.03))], -1)
        role = functional.one_hot(roles, ROLES).to(points.dtype).expand(len(points), -1, -1)
        task_token = self.task(task)
        tokens = self.point(torch.cat([shown, role], -1)) + task_token[:, None]
        tokens = torch.cat([task_token[:, None], tokens], 1)
        mask = torch.cat([torch.ones_like(mask[:, :1]), mask], 1)
        for layer in self.encoder:
            tokens = layer(tokens, mask)
        return self.memory(tokens), mask

    def compute_flow(self, memory: tuple[Tensor, Tensor], noisy: Tensor, time: Tensor) -> Tensor:
        """Compute the velocity of noisy goals, (b, m, GOAL), each by itself, at times (b, m) from 0 to 1."""
        angle = time[..., None] * (2.0 ** torch.arange(8, device=time.device)) * (torch.pi / 2)
        x = self.noisy(torch.cat([noisy, angle.sin(), angle.cos()], -1))
        x = x + memory[0][:, :1]
        for layer in self.decoder:
            x = layer(x, memory[1], memory[0])
        return self.flow(x).float()

    def draw(self, memory: tuple[Tensor, Tensor], noise: Tensor) -> Tensor:
        """Carry noise to goals. Both of shape (b, m, GOAL)."""
        goals = noise
        for step in range(FLOW_STEPS):
            time = torch.full(noise.shape[:2], step / FLOW_STEPS, device=noise.device)
            goals = goals + self.compute_flow(memory, goals, time) / FLOW_STEPS
        return goals


class ChunkNetwork(Module):  # type: ignore[misc]
    """The robot's state and the objects, both in the goal's frame; the next samples of the motion."""

    def __init__(self) -> None:
        super().__init__()
        self.state = make_perceptron(STATE, WIDTH)
        self.point = make_perceptron(3 * 3 + ROLES, WIDTH)
        self.layers = nn.ModuleList([Attention() for _ in range(MOTION)])
        self.head = nn.Sequential(nn.LayerNorm(WIDTH), nn.Linear(WIDTH, 2 * WIDTH), nn.GELU())
        self.chunk = nn.Linear(2 * WIDTH, CHUNK * (STEP + GATES))

    def forward(self, state: Tensor, points: Tensor, mask: Tensor) -> Tensor:
        """Compute a chunk.

        Args:
            state: Shape (b, STATE).
            points: Of each object, X and Y first, in the goal's frame. Shape (b, r, p, 3) [m].
            mask: Which objects are there. Shape (b, r).

        Each step has gates more, shares of what is left to the goal and to its openings: so that arrival is exact, and
        what is predicted beside them may be coarse.

        Returns:
            Position from the present one [`POSITION_UNIT_M`], rotation vector from the present orientation [rad],
            opening [`OPENING_UNIT_M`] and scores of the phases. Shape (b, CHUNK, STEP).
        """
        roles = torch.arange(points.shape[1], device=points.device).clamp(max=ROLES - 1)
        role = functional.one_hot(roles, ROLES).to(points.dtype)[:, None].expand(*points.shape[:3], -1)
        objects = self.point(torch.cat([expand_lengths(points, (0.3, 0.1, 0.03)), role], -1)).amax(2)
        tokens = torch.cat([self.state(state)[:, None], objects], 1)
        mask = torch.cat([torch.ones_like(mask[:, :1]), mask], 1)
        for layer in self.layers:
            tokens = layer(tokens, mask)
        chunk = self.chunk(self.head(tokens[:, 0])).reshape(-1, CHUNK, STEP + GATES).float()
        left = describe_left(state.float())[:, None]
        gated = chunk[..., STEP:] * left
        change = torch.cat([gated[..., :6], gated[..., 6:7] + gated[..., 7:8] - state[:, None, 24:25].float()], -1)
        return torch.cat([chunk[..., :7] - change, chunk[..., 7:STEP]], -1)


def describe_left(state: Tensor) -> Tensor:
    """Compute what is left to go from a described state: position, rotation, two openings. Shape (b, GATES)."""
    position = state[:, :3] * LINEAR_M / POSITION_UNIT_M
    turn = vector_from_matrix(matrix_from_columns(state[:, 9:15]))
    return torch.cat([position, turn, state[:, 24:25] - state[:, 26:28]], 1)


class StateNetwork(Module):  # type: ignore[misc]
    """Both networks, trained together."""

    def __init__(self) -> None:
        super().__init__()
        self.goal, self.motion = GoalNetwork(), ChunkNetwork()


def make_network(seed: int) -> Any:
    """Make the networks with weights from a seed, on the CPU."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return StateNetwork()
