"""What is read of a MuJoCo model: the numbers, kinds and places of its geoms."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from ..core.errors import ArgumentError, kind_of, whole_number

# mjtGeom's numbers, in their order.
_TYPES = ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh", "sdf")


def require_model(owner: str, model: Any) -> None:
    if not hasattr(model, "ngeom"):
        raise ArgumentError(owner, "model", f"must be a mujoco.MjModel, or MJX's, it is {kind_of(model)}")


def geom_number(owner: str, argument: str, model: Any, geom: int | str) -> int:
    """The number of a geom that is given by its number, or by its name where the model knows names; else ArgumentError."""
    require_model(owner, model)
    if isinstance(geom, str):
        try:
            return int(model.geom(geom).id)
        except (KeyError, AttributeError) as error:  # MJX's model has no names
            rule = f"must be a geom's number, or its name in a mujoco.MjModel; no geom there is named {geom!r}"
            raise ArgumentError(owner, argument, rule) from error
    number = whole_number(geom)
    if not isinstance(number, int):
        raise ArgumentError(owner, argument, f"must be a geom's number or name, it is {geom!r}")
    if not 0 <= number < model.ngeom:
        raise ArgumentError(owner, argument, f"must be a number from 0 to {model.ngeom - 1}, it is {geom!r}")
    return number


def geom_type(model: Any, number: int) -> str:
    kind = int(model.geom_type[number])
    return _TYPES[kind] if 0 <= kind < len(_TYPES) else "geom of another kind"


def is_seen(model: Any, number: int) -> bool:
    """Whether `mj_ray` meets a geom: not one that is transparent altogether."""
    material = int(model.geom_matid[number])
    colour = model.geom_rgba[number] if material < 0 else model.mat_rgba[material]
    return float(colour[3]) > 0


def _bodies(model: Any, number: int) -> Iterator[int]:
    """A geom's body, the one that carries it, and so on, without the world."""
    body = int(model.geom_bodyid[number])
    while body:
        yield body
        body = int(model.body_parentid[body])


def moves(model: Any, number: int) -> bool:
    """Whether a joint, or a mocap body's place, moves a geom."""
    return any(int(model.body_jntnum[body]) or int(model.body_mocapid[body]) >= 0 for body in _bodies(model, number))


def geom_pose(model: Any, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Position and quaternion of a geom in the world, while no joint has moved."""
    pos, quat = np.array(model.geom_pos[number], np.float64), np.array(model.geom_quat[number], np.float64)
    for body in _bodies(model, number):
        turn = np.array(model.body_quat[body], np.float64)
        pos, quat = np.array(model.body_pos[body]) + _rotated(turn, pos), _product(turn, quat)
    return pos, quat


def hfield_numbers(model: Any, number: int) -> tuple[Any, np.ndarray]:
    """Data (..., nrow, ncol) and size of a geom that is a height field; MJX's models may hold a batch, and `jit` trace them."""
    asset = int(model.geom_dataid[number])
    nrow, ncol, first = (int(array[asset]) for array in (model.hfield_nrow, model.hfield_ncol, model.hfield_adr))
    data = model.hfield_data[..., first : first + nrow * ncol]
    data = data.copy() if isinstance(data, np.ndarray) else data  # a simulation may write to its own later
    return data.reshape(*data.shape[:-1], nrow, ncol), np.array(model.hfield_size[asset], np.float64)


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The quaternion of `b` followed by `a`."""
    return np.r_[a[0] * b[0] - a[1:] @ b[1:], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])]


def _rotated(quat: np.ndarray, v: np.ndarray) -> np.ndarray:
    return v + 2 * np.cross(quat[1:], np.cross(quat[1:], v) + quat[0] * v)
