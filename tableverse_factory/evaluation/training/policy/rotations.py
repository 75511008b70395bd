"""Rotations as tensors: quaternions wxyz, matrices, rotation vectors [rad], and the first two columns of a matrix."""

from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()


def matrix_from_quaternion(quaternion_wxyz: Tensor) -> Tensor:
    """Convert quaternions, normalized here, to matrices. Shapes (…, 4) and (…, 3, 3)."""
    w, x, y, z = torch.nn.functional.normalize(quaternion_wxyz, dim=-1).unbind(-1)
    rows = (
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    )
    return torch.stack(rows, -2)


def columns_from_matrix(matrix: Tensor) -> Tensor:
    """Take the first two columns. Shapes (…, 3, 3) and (…, 6)."""
    return torch.cat([matrix[..., 0], matrix[..., 1]], -1)


def matrix_from_columns(columns: Tensor) -> Tensor:
    """Orthonormalize two columns and add the third (Zhou et al., 2019). Shapes (…, 6) and (…, 3, 3)."""
    normalize = torch.nn.functional.normalize
    first = normalize(columns[..., :3], dim=-1)
    second = columns[..., 3:] - (first * columns[..., 3:]).sum(-1, keepdim=True) * first
    second = normalize(second, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], -1)


def vector_from_matrix(matrix: Tensor) -> Tensor:
    """Compute rotation vectors of angles below pi. Shapes (…, 3, 3) and (…, 3)."""
    m = matrix
    twice = torch.stack([m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], -1)
    sine = twice.norm(dim=-1, keepdim=True) / 2
    cosine = (m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2] - 1)[..., None] / 2
    return twice / 2 * torch.where(sine > 1e-6, torch.atan2(sine, cosine) / sine.clamp(min=1e-6), 1.0)


def matrix_from_vector(vector: Tensor) -> Tensor:
    """Compute the rotation about a vector by its length (Rodrigues). Shapes (…, 3) and (…, 3, 3)."""
    angle = vector.norm(dim=-1)[..., None, None]
    x, y, z = torch.nn.functional.normalize(vector, dim=-1).unbind(-1)
    none = torch.zeros_like(x)
    cross = torch.stack(
        [torch.stack([none, -z, y], -1), torch.stack([z, none, -x], -1), torch.stack([-y, x, none], -1)], -2
    )
    return torch.eye(3, device=vector.device) + angle.sin() * cross + (1 - angle.cos()) * (cross @ cross)


def turn_about_z(angle: Tensor) -> Tensor:
    """Compute rotations about the vertical. Shapes (…,) and (…, 3, 3)."""
    c, s, none = angle.cos(), angle.sin(), torch.zeros_like(angle)
    rows = (torch.stack([c, -s, none], -1), torch.stack([s, c, none], -1), torch.stack([none, none, none + 1], -1))
    return torch.stack(rows, -2)


def apply(matrix: Tensor, vectors: Tensor) -> Tensor:
    """Rotate vectors. Shapes (…, 3, 3) and (…, 3); a sum of products, as GPUs multiply many small matrices slowly."""
    return (matrix * vectors[..., None, :]).sum(-1)
