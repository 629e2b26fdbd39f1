"""MuJoCo's height field: heights on a grid over a solid base, somewhere in the world."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Float

from ..core.errors import ArgumentError, UserError, kind_of
from ..core.rules import require
from ..core.settings import Settings
from ..core.types import NUMBERS, AnyArray, Number, array_leaf, float_leaf, height_leaf
from ..rendering.render import heightfield_grids
from ..trace.grid import Grid
from .model import geom_number, geom_pose, geom_type, hfield_numbers

SEARCHED = Settings(shading="flat")  # for grids in which a triangle is searched for, cells by cells by data


class HField(eqx.Module):
    """A height field as MuJoCo has it, or a batch of them: a surface, four walls under its border and a base.

    In its own frame vertex (r, c) stands at x = -size[0] + 2 size[0] c / (ncol - 1), y = -size[1] + 2 size[1] r / (nrow - 1),
    z = data[r, c] size[2]; each cell is split along (r, c)-(r+1, c+1). The base is a box from z = -size[3] to 0. All of it can
    be hit from either side, the base's upper face from within the solid too, as in MuJoCo.

    A batch has leading axes; `size`, `pos` and `quat` may be given without them, for all alike. Nothing is compiled again for
    other numbers in the same shapes.

    What breaks a rule below is a ValueError, but for numbers that `jit` traces: there a zero quat is the identity, as for
    `mju_normalize4`, and other numbers stand as they are.

    Attributes:
      data: shape (..., nrow, ncol), at least 2x2, 0 to 1, row 0 at -y. Its dtype, float32 or float64, is the precision of rays.
        MuJoCo's compiler brings what it reads from files and XML to 0 to 1; of what is written into `hfield_data` it loses
        rays beyond.
      size: shape (..., 4): half of the extent in x and in y, the height of data = 1, the depth of the base; all positive.
      pos, quat: where it stands in the world, shapes (..., 3) and (..., 4), quat as (w, x, y, z), not zero, of any length.
      upright: whether `quat` was known to be a rotation about z when this was made. Rays straight down then need no search. One
        that is to be tilted must be made anew, as this is not looked at again.
    """

    data: Float[AnyArray, "*batch nrow ncol"]
    size: Float[AnyArray, "*batch 4"]
    pos: Float[AnyArray, "*batch 3"]
    quat: Float[AnyArray, "*batch 4"]
    upright: bool = eqx.field(static=True, init=False)
    _grid: Grid | None = eqx.field(init=False)

    def __init__(self, data: Any, size: Any, pos: Any = (0, 0, 0), quat: Any = (1, 0, 0, 0)):
        self.data = height_leaf("HField", "data", data)
        if self.data.ndim < 2 or min(self.data.shape[-2:]) < 2:
            rule = f"must have shape (..., nrow, ncol) of at least 2x2, its shape is {self.data.shape}"
            raise ArgumentError("HField", "data", rule)
        self.size, self.pos, self.quat = (
            self._numbers(name, value, length)
            for name, value, length in (("size", size, 4), ("pos", pos, 3), ("quat", quat, 4))
        )
        leaves = self.data, self.size, self.quat
        data, size, quat = (None if isinstance(leaf, Tracer) else np.asarray(leaf) for leaf in leaves)
        if data is not None and data.size and not (data.min() >= 0 and data.max() <= 1):
            raise ArgumentError("HField", "data", f"must lie from 0 to 1, it goes from {data.min():g} to {data.max():g}")
        if size is not None and not (size > 0).all():
            raise ArgumentError("HField", "size", f"must be positive, it is {size.tolist()}")
        if quat is not None and not quat.any(axis=-1).all():
            raise ArgumentError("HField", "quat", "must not be zero, it is (0, 0, 0, 0)")
        self._grid, self.upright = None, quat is not None and not quat[..., 1:3].any()

    def _numbers(self, name: str, value: Any, length: int) -> Any:
        """That many numbers for each height field of the batch, from as many or from those for all alike."""
        leaf, wanted = known_numbers("HField", name, value), (*self.batch, length)
        if leaf.shape == wanted:
            return leaf
        if leaf.shape != (length,):
            either = f"{(length,)} or {wanted}" if self.batch else f"{wanted}"
            raise ArgumentError("HField", name, f"must have shape {either}, its shape is {leaf.shape}")
        return (np if isinstance(leaf, np.ndarray) else jnp).broadcast_to(leaf, wanted)

    @property
    def dtype(self) -> Any:
        """The precision of rays."""
        return self.data.dtype

    @property
    def batch(self) -> tuple[int, ...]:
        """The leading axes of a batch; () for one."""
        return self.data.shape[:-2]

    def prepared(self) -> "HField":
        """The same with bounds of the heights at hand, which rays that walk otherwise take anew in each call.

        For many calls with the same heights: other ones need an HField of their own. Bounds take 5 times the memory of heights.
        """
        data = lax.stop_gradient(self.data).reshape(-1, *self.data.shape[-2:])
        grids = heightfield_grids(data, 1.0, 1.0, SEARCHED)
        grids = jax.tree.map(lambda leaf: leaf.reshape(*self.batch, *leaf.shape[1:]), grids)
        return eqx.tree_at(lambda field: field._grid, self, grids, is_leaf=lambda leaf: leaf is None)

    @classmethod
    def from_model(cls, model: Any, geom: int | str) -> "HField":
        """The height field of a geom, where it stands while no joint has moved.

        Args:
          model: a `mujoco.MjModel`, or what has its arrays, as MJX's model. Leading axes of MJX's `hfield_data` are a batch.
          geom: its number; or its name, where the model knows names.

        Raises:
          ValueError: the geom is no height field.
        """
        number = geom_number("HField.from_model", "geom", model, geom)
        if geom_type(model, number) != "hfield":
            raise ArgumentError("HField.from_model", "geom", f"must be a height field, {geom!r} is none")
        return cls(*hfield_numbers(model, number), *geom_pose(model, number))


def as_numbers(owner: str, name: str, value: Any, dtype: Any) -> jax.Array:
    """An array of JAX's; ArgumentError where an argument is something else, as the `mjx.Data` whose `qpos` was meant."""
    try:
        return array_leaf(value, dtype)
    except (TypeError, ValueError) as error:
        raise ArgumentError(owner, name, f"must be numbers, it is {kind_of(value)}") from error


def known_numbers(owner: str, name: str, value: Any, rule: Number = NUMBERS) -> Any:
    """See `float_leaf`; ArgumentError where an argument is something else, or breaks a rule and is not traced."""
    try:
        leaf = float_leaf(value)
    except UserError as error:
        raise ArgumentError(owner, name, f"must be numbers, it is {kind_of(value)}") from error
    require(owner, name, leaf, rule)
    return leaf


def number_pair(owner: str, name: str, value: Any) -> tuple[float, float]:
    """Two numbers that are known and finite."""
    first, second = known_numbers(owner, name, value, Number(shape=(2,), shape_words="be two numbers"))
    return float(first), float(second)
