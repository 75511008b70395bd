"""Selection among drawn goals: where most of the others are."""

from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()

NEAR = 0.35  # distance of goals, as the network draws them, within which they support one another


def select_goals(drawn: Tensor) -> Tensor:
    """Rank goals by the density of all that were drawn, the densest first. Shapes (b, m, GOAL) and (b, m)."""
    away = torch.cdist(drawn[..., :9], drawn[..., :9])
    return torch.exp(-0.5 * (away / NEAR) ** 2).sum(2).argsort(dim=1, descending=True, stable=True)
