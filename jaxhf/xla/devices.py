"""Work dealt out to many devices."""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec as P

from ..core.errors import require_kind


@functools.cache
def local_mesh(most: int | None = None) -> Mesh:
    """All devices of this process, in a row, or so many of them."""
    devices = jax.local_devices()[:most]
    return jax.make_mesh((len(devices),), ("devices",), axis_types=(AxisType.Auto,), devices=devices)


def chosen_mesh(owner: str, mesh: Mesh | None) -> Mesh:
    """The mesh that an argument gives, by default all devices of this process; ArgumentError where it is none."""
    if mesh is None:
        return local_mesh()
    require_kind(owner, "mesh", mesh, Mesh, "a jax.sharding.Mesh", "jax.make_mesh makes one")
    return mesh


def on_every_device(tree: Any, mesh: Mesh) -> Any:
    """Copies arrays to each device of a mesh, wherever the caller has put them.

    What is still NumPy is left to the compiled program, which copies it by itself. Over several processes each must have the
    same values.
    """
    here = mesh.devices.ravel()
    if len(here) == 1 and here[0] == jax.devices()[0]:
        return tree

    def placed(leaf: Any) -> Any:
        if not isinstance(leaf, jax.Array):
            return leaf
        if not mesh.is_multi_process:
            return jax.device_put(leaf, NamedSharding(mesh, P()))
        # What belongs to one process can only be sent to another by way of the host, from which all start with the same.
        at_home = isinstance(leaf, Tracer) or jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return leaf if at_home or leaf.sharding.device_set == set(here) else np.asarray(leaf)

    return jax.tree.map(placed, tree)


def map_over(mesh: Mesh, fun: Callable[[Any, Any], Any], shared: Any, items: Any) -> Any:
    """`fun(shared, item)` for one item after the other, dealt out in turn to the devices of a mesh, whatever its axes.

    Each device gets all results. Pictures are those of one device, bit for bit; points on edges in single precision are not
    always. Derivatives with respect to `shared` are sums over devices.

    Args:
      shared: a pytree of arrays.
      items: a pytree of arrays whose leading axis counts the items.
    """

    def one_after_the_other(shared: Any, items: Any) -> Any:
        return lax.map(lambda item: fun(shared, item), items)

    devices, n = mesh.devices.size, jax.tree.leaves(items)[0].shape[0]
    if devices == 1:
        return one_after_the_other(shared, items)
    count = math.ceil(n / devices)
    turns = np.minimum(np.arange(count * devices), n - 1).reshape(count, devices).T
    over = jax.shard_map(
        lambda shared, items: one_after_the_other(shared, jax.tree.map(lambda leaf: leaf[0], items)),
        mesh=mesh,
        in_specs=(P(), P(mesh.axis_names)),
        out_specs=P(mesh.axis_names),
        check_vma=False,
    )

    def in_order(values: jax.Array) -> jax.Array:
        # Gathered before anything is made of it, or XLA would take sums in parts, in another order than on one device.
        values = lax.with_sharding_constraint(values, NamedSharding(mesh, P()))
        tail = values.shape[1:]
        return values.reshape(devices, count, *tail).swapaxes(0, 1).reshape(devices * count, *tail)[:n]

    return jax.tree.map(in_order, over(shared, jax.tree.map(lambda leaf: leaf[turns], items)))
