"""Poses of cameras: that which looks at a point, and what is none."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from ..core.affine import invertible
from ..core.errors import ArgumentError
from ..core.rules import require
from ..core.types import VECTOR, float_leaf
from ..core.vector import unit


def look_at_pose(eye: Any, target: Any, up: Any) -> Any:
    eye, target, up = leaves = float_leaf(eye), float_leaf(target), float_leaf(up)
    for name, leaf in zip(("eye", "target", "up"), leaves, strict=True):
        require("look_at", name, leaf, VECTOR)
    host = all(isinstance(leaf, np.ndarray) for leaf in leaves)
    xp = np if host else jnp

    def direction(v):
        return v / np.sqrt((v * v).sum()) if host else unit(jnp.asarray(v))

    if host and not (target - eye).any():
        raise ArgumentError("look_at", "target", f"must differ from eye, both are {eye.tolist()}")
    forward = direction(target - eye)
    right = xp.cross(forward, up)
    if host and not np.linalg.norm(right) > 1e-9 * np.linalg.norm(up):
        rule = f"must not point along the view, it is {up.tolist()} for the view {forward.tolist()}"
        raise ArgumentError("look_at", "up", rule)
    right = direction(right)
    columns = xp.stack([right, xp.cross(right, forward), forward, eye], axis=1)
    return xp.concatenate([columns, xp.asarray([[0.0, 0.0, 0.0, 1.0]], dtype=columns.dtype)])


def require_pose(matrix: Any) -> None:
    """Raises ArgumentError on a matrix that does more than rotate and translate, as the wrong one of two would."""
    require("from_intrinsics", "world_from_camera", matrix, invertible)
    if isinstance(matrix, np.ndarray):
        turn = matrix[:3, :3]
        if np.abs(turn.T @ turn - np.eye(3)).max() > 1e-3 or np.linalg.det(turn) < 0:
            rule = f"must rotate without scaling or mirroring, it is {turn.tolist()}"
            raise ArgumentError("from_intrinsics", "world_from_camera", rule)
