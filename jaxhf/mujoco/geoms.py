"""Several geoms, of which a ray meets the nearest: height fields and MuJoCo's primitives, where a simulation has them."""

from collections.abc import Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..core.errors import ArgumentError, counted, kind_of, require_kind, whole_number
from ..core.rules import OneOf, Whole, require
from ..core.types import AnyArray, array_leaf
from ..xla.compilation import compiled
from .hfield import HField, known_numbers
from .model import geom_number, geom_pose, geom_type, hfield_numbers, is_seen, moves, require_model
from .pose import quaternion
from .primitives import KINDS


class Geoms(eqx.Module):
    """Height fields and primitives, with MuJoCo's sizes and poses: what rays of sensors meet.

    Leading axes of `pos` and `quat` are a batch: in each of it the primitives stand elsewhere. So may the height fields, each
    with the same axes; one that has none stands still in all of the batch.

    Attributes:
      hfields: the height fields, in one precision, which is that of rays; without any it is JAX's own.
      kinds: of each primitive: "plane", "sphere", "capsule", "ellipsoid", "cylinder" or "box".
      size: shape (n, 3): MuJoCo's geom_size of each primitive.
      pos, quat: where each primitive stands, shapes (..., n, 3) and (..., n, 4), quat as (w, x, y, z), not zero, of any length.
      ids: the number of each geom, height fields first, as `Scan.geom` names it: that in the model, or else its place here.
      fixed: of each height field, whether `at` leaves it where it is.
    """

    hfields: tuple[HField, ...]
    kinds: tuple[str, ...] = eqx.field(static=True)
    size: Float[AnyArray, "n 3"]
    pos: Float[AnyArray, "*batch n 3"]
    quat: Float[AnyArray, "*batch n 4"]
    ids: tuple[int, ...] = eqx.field(static=True)
    fixed: tuple[bool, ...] = eqx.field(static=True)

    def __init__(
        self, hfields: Iterable[HField] = (), kinds: Sequence[str] = (), size: Any = None, pos: Any = None, quat: Any = None,
        ids: Sequence[int] | None = None, fixed: Sequence[bool] | None = None,
    ):  # fmt: skip
        """
        Args:
          hfields, kinds, size, pos, quat, ids, fixed: the attributes. None: nothing is turned, ids count on from 0, all moves.

        Raises:
          ValueError: an unknown kind, shapes that do not fit, a size that is negative, a quat that is zero.
        """
        self.hfields, self.kinds = _several("Geoms", "hfields", hfields), _several("Geoms", "kinds", kinds)
        for k, field in enumerate(self.hfields):
            require_kind("Geoms", f"hfields[{k}]", field, HField, "a jaxhf.mujoco.HField")
            if field.dtype != self.hfields[0].dtype:
                rule = f"must have the precision of the first height field, {self.hfields[0].dtype}, it has {field.dtype}"
                raise ArgumentError("Geoms", f"hfields[{k}]", rule)
        for k, kind in enumerate(self.kinds):
            require("Geoms", f"kinds[{k}]", kind, OneOf(KINDS))
        n, count = len(self.kinds), len(self.hfields)
        if not n and not count:
            raise ArgumentError("Geoms", "hfields", "must have one, where there is no primitive either")
        self.size, self.pos = _numbers("size", size, (n, 3)), _numbers("pos", pos, (..., n, 3))
        straight: Any = np.broadcast_to([1.0, 0, 0, 0], (*self.pos.shape[:-1], 4))
        self.quat = straight if quat is None else _numbers("quat", quat, (*self.pos.shape[:-1], 4))
        self.ids = tuple(range(count + n)) if ids is None else _several("Geoms", "ids", ids)
        self.ids = tuple(map(whole_number, self.ids))
        for k, number in enumerate(self.ids):
            require("Geoms", f"ids[{k}]", number, Whole(0))
        self.fixed = (False,) * count if fixed is None else _several("Geoms", "fixed", fixed)
        for name, found, wanted in (("ids", self.ids, count + n), ("fixed", self.fixed, count)):
            if len(found) != wanted:
                rule = f"must have {counted(wanted, 'value')}, one of each geom, it has {len(found)}"
                raise ArgumentError("Geoms", name, rule)
        self._require_sizes()
        self._require_batches()

    def _require_sizes(self) -> None:
        for k, kind in enumerate(self.kinds):
            size = self.size[k]
            used, rule = (size[:2], "not be negative") if kind == "plane" else (size[: _SIZES[kind]], "be positive")
            if isinstance(size, np.ndarray) and not ((used >= 0) if kind == "plane" else (used > 0)).all():
                raise ArgumentError("Geoms", f"size[{k}]", f"must {rule} of a {kind}, it is {size.tolist()}")
        if isinstance(self.quat, np.ndarray) and not self.quat.any(-1).all():
            raise ArgumentError("Geoms", "quat", "must not be zero, one is (0, 0, 0, 0)")

    def _require_batches(self) -> None:
        if self.pos.shape[:-2] not in ((), self.batch):
            rule = f"must have the axes {self.batch} of the height fields, or none, it has {self.pos.shape[:-2]}"
            raise ArgumentError("Geoms", "pos", rule)
        for k, field in enumerate(self.hfields):
            if field.batch not in ((), self.batch):
                rule = f"must have the axes {self.batch} of the others, or none, it has {field.batch}"
                raise ArgumentError("Geoms", f"hfields[{k}]", rule)

    @property
    def batch(self) -> tuple[int, ...]:
        """The leading axes of a batch; () for one."""
        batches = [self.pos.shape[:-2]] if self.kinds else []
        return max([*batches, *(field.batch for field in self.hfields)], key=len)

    @property
    def dtype(self) -> Any:
        """The precision of rays."""
        return self.hfields[0].dtype if self.hfields else jnp.result_type(float)

    def prepared(self) -> "Geoms":
        """See `HField.prepared`, for those that are fixed or stand here for many calls."""
        return eqx.tree_at(lambda geoms: geoms.hfields, self, tuple(field.prepared() for field in self.hfields))

    @classmethod
    def from_model(cls, model: Any, geoms: Iterable[int | str] | None = None) -> "Geoms":
        """Geoms of a model, where they stand while no joint has moved; see `at` for where they are then.

        Args:
          model: as for `HField.from_model`.
          geoms: numbers, or names where the model knows names; None: all that `mj_ray` sees, so all that are not transparent
            altogether. A sensor sees the robot that it is mounted on, unless that is left out here.

        Raises:
          ValueError: a geom that is a mesh or a signed distance field, or that the model does not have; none at all.
        """
        owner = "Geoms.from_model"
        require_model(owner, model)
        every = [k for k in range(model.ngeom) if is_seen(model, k)] if geoms is None else _several(owner, "geoms", geoms)
        numbers = [geom_number(owner, "geoms", model, geom) for geom in every]
        types = {number: geom_type(model, number) for number in numbers}
        for number, kind in types.items():
            if kind != "hfield" and kind not in KINDS:
                raise ArgumentError(owner, "geoms", f"must be height fields and primitives, {number} is a {kind}: leave it out")
        fields, solids = ([number for number in numbers if (types[number] == "hfield") == want] for want in (True, False))
        poses = [geom_pose(model, number) for number in solids]
        return cls(
            [HField(*hfield_numbers(model, number), *geom_pose(model, number)) for number in fields],
            [types[number] for number in solids],
            [np.array(model.geom_size[number], np.float64) for number in solids],
            [pos for pos, _ in poses],
            [quat for _, quat in poses],
            [*fields, *solids],
            [not moves(model, number) for number in fields],
        )

    def at(self, data: Any) -> "Geoms":
        """The same geoms of a model where its simulation has them now; differentiable in the data.

        Height fields that no joint moves stay as they are. One that moves is made anew, and of a batch of data copied for each.

        Args:
          data: a `mujoco.MjData`, or MJX's data, or a batch of these, after a step or `mj_forward`. Where height fields are
            a batch, each with terrain of its own, the data are one with the same axes.

        Raises:
          ValueError: the data have no `geom_xpos` and `geom_xmat`, or not of so many geoms, or not the axes of these geoms.
        """
        xpos, xmat = (getattr(data, name, ()) for name in ("geom_xpos", "geom_xmat"))
        shape: tuple[int, ...] = np.shape(xpos)
        if len(shape) < 2 or shape[-1] != 3 or np.size(xmat) != 3 * np.size(xpos):
            rule = f"must be a simulation's, with geom_xpos and geom_xmat, it is {kind_of(data)}"
            raise ArgumentError("Geoms.at", "data", rule)
        if shape[-2] <= max(self.ids):
            rule = f"must have the geoms of the model that these are from, {max(self.ids)} among them, it has {shape[-2]}"
            raise ArgumentError("Geoms.at", "data", rule)
        batch, count, fields = shape[:-2], len(self.hfields), []
        if self.batch not in ((), batch):
            rule = f"must have the axes {self.batch} of the geoms, geom_xpos has shape {shape}"
            raise ArgumentError("Geoms.at", "data", rule)
        pos, quat = _poses(array_leaf(xpos, self.dtype), array_leaf(xmat, self.dtype), np.array(self.ids))
        for k, (field, fixed) in enumerate(zip(self.hfields, self.fixed, strict=True)):
            if fixed:
                fields.append(field)
                continue
            copies, grid = field.data, field._grid
            if not field.batch:
                copies, grid = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, batch + leaf.shape), (copies, grid))
            moved = HField(copies, field.size, pos[..., k, :], quat[..., k, :])
            fields.append(eqx.tree_at(lambda field: field._grid, moved, grid, is_leaf=lambda leaf: leaf is None))
        places = self.pos, self.quat
        if self.kinds:
            places = pos[..., count:, :], quat[..., count:, :]
        return eqx.tree_at(lambda geoms: (geoms.hfields, geoms.pos, geoms.quat), self, (tuple(fields), *places))


@compiled
def _poses(
    xpos: Float[jax.Array, "*batch all 3"], xmat: Float[jax.Array, "*batch_and_numbers"], ids: Int[AnyArray, " n"]
) -> tuple[Float[jax.Array, "*batch n 3"], Float[jax.Array, "*batch n 4"]]:
    """Positions and quaternions of some geoms, from those of all and their rotations, as 3 x 3 or as nine numbers."""
    pos = jnp.take(xpos, ids, axis=-2)
    matrices = jnp.take(xmat.reshape(*xpos.shape[:-1], 9), ids, axis=-2)
    return pos, jax.vmap(quaternion)(matrices.reshape(-1, 3, 3)).reshape(*pos.shape[:-1], 4)


def _numbers(name: str, value: Any, shape: tuple[Any, ...]) -> Any:
    """Numbers whose shape ends so behind `...`, or is this one; of no primitive there need be none."""
    ends, free = shape[-2:], shape[0] is ...
    leaf = known_numbers("Geoms", name, () if value is None else value)
    leaf = np.zeros(ends) if leaf.size == 0 and not ends[0] else leaf
    if leaf.ndim < 2 or leaf.shape[-2:] != ends if free else leaf.shape != shape:
        wanted = ", ".join("..." if part is ... else str(part) for part in shape)
        raise ArgumentError("Geoms", name, f"must have shape ({wanted}), its shape is {leaf.shape}")
    return leaf


def _several(owner: str, name: str, given: Any) -> tuple[Any, ...]:
    if isinstance(given, str) or not isinstance(given, Iterable):
        found = repr(given) if isinstance(given, str) else kind_of(given)
        raise ArgumentError(owner, name, f"must be several, in a list, it is {found}")
    return tuple(given)


# How many numbers of each kind's size are used.
_SIZES = {"sphere": 1, "capsule": 2, "ellipsoid": 3, "cylinder": 2, "box": 3}
