"""What is read of a MuJoCo model: the numbers, kinds and places of its geoms."""

from typing import Any

import numpy as np

from ..core.errors import ArgumentError, kind_of, whole_number

# mjtGeom's numbers, in their order.
TYPES = ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh", "sdf")


def require_model(owner: str, model: Any) -> None:
    if not hasattr(model, "ngeom"):
        raise ArgumentError(owner, "model", f"must be a mujoco.MjModel, or MJX's, it is {kind_of(model)}")


def geom_number(owner: str, argument: str, model: Any, geom: int | str) -> int:
    """The number of a geom that is given by its number, or by its name where the model knows names; else ArgumentError."""
    require_model(owner, model)
    number: Any = whole_number(geom)
    if isinstance(geom, str):
        try:
            number = model.geom(geom).id
        except (KeyError, AttributeError) as error:  # MJX's model has no names
            rule = f"must be a geom's number, or its name in a mujoco.MjModel; no geom there is named {geom!r}"
            raise ArgumentError(owner, argument, rule) from error
    if not isinstance(whole_number(number), int):
        raise ArgumentError(owner, argument, f"must be a geom's number or name, it is {geom!r}")
    if not 0 <= number < model.ngeom:
        raise ArgumentError(owner, argument, f"must be a number from 0 to {model.ngeom - 1}, it is {geom!r}")
    return int(number)


def geom_type(model: Any, number: int) -> str:
    kind = int(model.geom_type[number])
    return TYPES[kind] if 0 <= kind < len(TYPES) else "geom of another kind"


def is_seen(model: Any, number: int) -> bool:
    """Whether `mj_ray` meets a geom: not one that is transparent altogether."""
    material = int(model.geom_matid[number])
    colour = model.geom_rgba[number] if material < 0 else model.mat_rgba[material]
    return float(colour[3]) > 0


def moves(model: Any, number: int) -> bool:
    """Whether a joint, or a mocap body's place, moves a geom."""
    body = int(model.geom_bodyid[number])
    while body:
        if int(model.body_jntnum[body]) or int(model.body_mocapid[body]) >= 0:
            return True
        body = int(model.body_parentid[body])
    return False


def geom_pose(model: Any, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Position and quaternion of a geom in the world, while no joint has moved."""
    pos, quat = np.array(model.geom_pos[number], np.float64), np.array(model.geom_quat[number], np.float64)
    body = int(model.geom_bodyid[number])
    while body:
        parent = np.array(model.body_quat[body], np.float64)
        pos, quat = np.array(model.body_pos[body]) + _rotated(parent, pos), _product(parent, quat)
        body = int(model.body_parentid[body])
    return pos, quat


def hfield_numbers(model: Any, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Data (nrow, ncol) and size of a geom that is a height field."""
    asset = int(model.geom_dataid[number])
    nrow, ncol, first = (int(array[asset]) for array in (model.hfield_nrow, model.hfield_ncol, model.hfield_adr))
    data = np.array(model.hfield_data[first : first + nrow * ncol]).reshape(nrow, ncol)
    return data, np.array(model.hfield_size[asset], np.float64)


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The quaternion of `b` followed by `a`."""
    return np.r_[a[0] * b[0] - a[1:] @ b[1:], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])]


def _rotated(quat: np.ndarray, v: np.ndarray) -> np.ndarray:
    return v + 2 * np.cross(quat[1:], np.cross(quat[1:], v) + quat[0] * v)
