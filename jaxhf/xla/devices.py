"""Work dealt out to many devices."""

import contextlib
import functools
import math
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.experimental import multihost_utils
from jax.extend.core import jaxpr_as_fun
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec as P

from ..core.errors import ArgumentError, UserError, require_kind
from ..core.types import room
from .compilation import is_traced
from .machine import peak_mb

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

# A device more of a CPU costs 7 ms a run, and so many rays take 10 (one terrain) to 300 ms (mirrors) to trace.
_RAYS_A_DEVICE = 2**16
_LEAST_DIVIDED = 2**14  # numbers of an array


class Spread(eqx.Module):
    """Arrays whose axis 1 is divided among the devices of a mesh, each of which holds its part alone."""

    values: Any


@functools.cache
def local_mesh(most: int | None = None) -> Mesh:
    """All devices of this process, in a row, or so many of them."""
    devices = jax.local_devices()[:most]
    return jax.make_mesh((len(devices),), ("devices",), axis_types=(AxisType.Auto,), devices=devices)


def worthwhile_mesh(rays: int) -> Mesh:
    """All devices of this process, but of a CPU's at most as many as pay for so many camera rays."""
    return local_mesh(max(1, rays // _RAYS_A_DEVICE) if jax.default_backend() == "cpu" else None)


def peak_device_mb() -> float:
    """The most memory of a device that has been held so far, MiB: on a CPU that of this process."""
    device = jax.local_devices()[0]
    return peak_mb() if device.platform == "cpu" else (device.memory_stats() or {}).get("peak_bytes_in_use", 0) / 2**20


def chosen_mesh(owner: str, mesh: Mesh | None, tree: Any = ()) -> Mesh:
    """The mesh that an argument gives, by default that of `jax.set_mesh`, or else all devices of this process.

    Within a `shard_map` or a `pmap` that is the device itself. Where no mesh has been set, axes of any type become those that
    XLA deals with.

    Raises:
      ArgumentError: it is no mesh, or another than that in which JAX is; or `tree`, the values to be computed with, is under
        the check of `shard_map` that `check_vma=False` leaves out.
    """
    if mesh is not None:
        require_kind(owner, "mesh", mesh, Mesh, "a jax.sharding.Mesh", "jax.make_mesh makes one")
    around = jax.sharding.get_abstract_mesh()
    if around.empty:
        return local_mesh() if mesh is None else Mesh(mesh.devices, mesh.axis_names)
    if around.manual_axes:
        if mesh is not None:
            raise ArgumentError(owner, "mesh", "must be None within a shard_map or pmap, where each device works for itself")
        if any(jax.typeof(leaf).mat.varying for leaf in jax.tree.leaves(tree)):
            raise UserError(f"{owner}: the shard_map around it needs check_vma=False")
        return local_mesh(1)
    if mesh is not None and mesh.abstract_mesh != around:
        raise ArgumentError(owner, "mesh", f"must be None or that of jax.set_mesh, {around}, it is {mesh}")
    if mesh is None and is_traced():  # when JAX tells no more than the mesh's form, which is all that counts then
        return Mesh(np.array(jax.devices()[: around.size]).reshape(around.axis_sizes), around.axis_names, around.axis_types)
    return mesh or jax.sharding.get_mesh()


@contextlib.contextmanager
def automatic_axes(owner: str, mesh: Mesh | None) -> Iterator[Mesh | None]:
    """Within `jax.set_mesh` of explicit axes: the same devices, with axes that XLA deals with; gives the mesh to go on with.

    For libraries whose programs JAX does not take with explicit axes: optimistix's conditionals have branches of two shardings.

    Raises:
      ArgumentError: see `chosen_mesh`.
    """
    if AxisType.Explicit not in jax.sharding.get_abstract_mesh().axis_types:
        yield mesh
        return
    explicit = chosen_mesh(owner, mesh)
    automatic = Mesh(explicit.devices, explicit.axis_names)
    with jax.set_mesh(automatic):
        yield automatic


def prepared_mesh(owner: str, prepared: Mesh, mesh: Mesh | None, tree: Any) -> Mesh:
    """As `chosen_mesh`, for what was prepared on a mesh, which is the default; UserError where that is another than JAX's."""
    here, around = chosen_mesh(owner, mesh, tree), jax.sharding.get_abstract_mesh()
    if around.manual_axes:
        return here
    if mesh is None and around.empty:
        here = Mesh(prepared.devices, prepared.axis_names)
    if here != prepared if around.empty else prepared.abstract_mesh != around:
        raise UserError(f"{owner}: the scene was prepared on {prepared}, it cannot be used on {here}")
    return prepared


def on_every_device(tree: Any, mesh: Mesh) -> Any:
    """Copies arrays to each device of a mesh, wherever the caller has put them; what is `Spread` is divided among them.

    What is still NumPy is left to the compiled program, which copies it by itself. Over several processes each must have the
    same values.
    """

    return tree if _at_home(mesh) else _placed_each(lambda leaf, place=P(): _placed(leaf, mesh, place), tree, mesh)


def _placed_each(place: Callable[..., Any], tree: Any, mesh: Mesh) -> Any:
    """`place(leaf)` of each, and `place(leaf, its place)` of what is `Spread`."""

    def placed(leaf: Any) -> Any:
        if isinstance(leaf, Spread):
            return jax.tree.map(lambda part: place(part, P(None, mesh.axis_names)), leaf)
        return place(leaf)

    return jax.tree.map(placed, tree, is_leaf=lambda leaf: isinstance(leaf, Spread))


def held_everywhere(tree: Any, mesh: Mesh) -> Any:
    """What was computed of arrays that are on each device of a mesh, for many uses there.

    Over several processes each computes it on one of its devices, and each use would copy it to the others.
    """

    return everywhere(jax.tree.map(np.asarray, tree), mesh) if mesh.is_multi_process and not is_traced() else tree


def everywhere(tree: Any, mesh: Mesh) -> Any:
    """NumPy's arrays, the same ones in each process, on each device of a mesh; what is `Spread` is divided among them. They may
    not be changed from then on, as CPU devices take those that begin as XLA's do, see `room`, as they are."""

    def copied(values: np.ndarray, place: P = P()) -> jax.Array:
        if not values.flags.c_contiguous:
            values, parts = room(values.shape, values.dtype), values
            values[...] = parts
        if _at_home(mesh):
            return jax.device_put(values)
        return jax.make_array_from_callback(values.shape, NamedSharding(mesh, place), lambda index: values[index])

    return _placed_each(copied, tree, mesh)


def divided(tree: Any, mesh: Mesh) -> Any:
    """Divides arrays along their first axis among the devices of a mesh; those that it does not divide, and small ones, are
    copied to each."""

    def placed(leaf: Any) -> Any:
        fits = getattr(leaf, "size", 0) >= _LEAST_DIVIDED and leaf.shape[0] % mesh.devices.size == 0
        return _placed(leaf, mesh, P(mesh.axis_names) if fits else P())

    return tree if _at_home(mesh) else jax.tree.map(placed, tree)


def _at_home(mesh: Mesh) -> bool:
    """Whether arrays are where they belong, wherever JAX has put them."""
    here, around = mesh.devices.ravel(), jax.sharding.get_abstract_mesh()
    return bool(around.manual_axes) or (around.empty and len(here) == 1 and here[0] == jax.devices()[0])


def _placed(leaf: Any, mesh: Mesh, place: P) -> Any:
    around = jax.sharding.get_abstract_mesh()
    if isinstance(leaf, jax.ShapeDtypeStruct):
        kind = mesh.devices.flat[0].default_memory().kind  # which an array's own sharding names
        return leaf.update(sharding=NamedSharding(mesh, place, memory_kind=kind))
    if not isinstance(leaf, jax.Array):
        return leaf
    traced = isinstance(leaf, Tracer)
    if traced and place != P():  # within `jax.set_mesh` its axes are ones that XLA deals with, which `reshard` refuses
        return lax.with_sharding_constraint(leaf, NamedSharding(mesh if around.empty else around, place))
    if not mesh.is_multi_process:
        whole = not around.empty and place == P()
        return jax.reshard(leaf, place) if whole else jax.device_put(leaf, NamedSharding(mesh, place))
    if traced or jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) or leaf.sharding.device_set == set(mesh.devices.ravel()):
        return leaf
    # What belongs to one process can only be sent to another by way of the host, from which all start with the same.
    values = np.asarray(leaf)
    if place == P():
        return values
    return jax.make_array_from_callback(values.shape, NamedSharding(mesh, place), lambda index: values[index])


def on_host(tree: Any) -> Any:
    """NumPy's arrays of all values, also of those that devices of other processes hold."""

    def whole(leaf: jax.Array) -> np.ndarray:
        return np.asarray(leaf if leaf.is_fully_addressable else multihost_utils.process_allgather(leaf, tiled=True))

    return jax.tree.map(whole, tree)


def where_called(owner: str, tree: Any) -> Any:
    """For what uses one device: within `jax.set_mesh` a copy of its arrays on each device, else the arrays where they are.

    Raises:
      UserError: see `chosen_mesh`.
    """
    mesh = chosen_mesh(owner, None, tree)
    return tree if jax.sharding.get_abstract_mesh().empty else on_every_device(tree, mesh)


def takes_numbers(fun: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """`fun`, within which NumPy's arrays may go to devices whatever `jax.transfer_guard` says of the caller's own program.

    Cameras, lights and transforms are NumPy's until they are rendered. Compiled programs take them as they are, in less time
    than `jax.device_put` takes for each leaf; to the guard that is a transfer by mistake.
    """

    @functools.wraps(fun)
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        with jax.transfer_guard_host_to_device("allow"):
            return fun(*args, **kwargs)

    return call


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
    around = jax.sharding.get_abstract_mesh()
    if AxisType.Explicit in around.axis_types:
        dealt_out: Any = jax.sharding.auto_axes(functools.partial(map_over, mesh, fun), out_sharding=P())
        return dealt_out(shared, items)
    given = mesh if around.empty else around
    turns = _turns(n, devices)
    over = jax.shard_map(
        lambda shared, items: one_after_the_other(shared, jax.tree.map(lambda leaf: leaf[0], items)),
        mesh=given,
        in_specs=(P(), P(mesh.axis_names)),
        out_specs=P(mesh.axis_names),
        check_vma=False,
    )

    def in_order(values: jax.Array) -> jax.Array:
        # Before anything is made of it, or XLA would take sums in parts, in another order than on one device.
        values = lax.with_sharding_constraint(values, NamedSharding(given, P()))
        tail = values.shape[1:]
        return values.reshape(devices, -1, *tail).swapaxes(0, 1).reshape(-1, *tail)[:n]

    return jax.tree.map(in_order, over(shared, jax.tree.map(lambda leaf: leaf[turns], items)))


def map_first(mesh: Mesh, fun: Callable[[Any, Any], Any], shared: Any, items: Any, count: Any) -> Any:
    """`fun(shared, item)` for the first `count` items, a number that is data, dealt out in turn to the devices of a mesh.

    Results stay where they are made, those of one device after those of the other; see `by_item`. Those of further
    items are 0. Has no reverse derivative.
    """

    def the_first(shared: Any, items: Any, numbers: jax.Array, count: jax.Array) -> Any:
        one, form = jax.make_jaxpr(fun, return_shape=True)(shared, jax.tree.map(lambda leaf: leaf[0], items))
        forms, structure = jax.tree.flatten(form)

        def step(k: jax.Array, found: list[jax.Array]) -> list[jax.Array]:
            results = jaxpr_as_fun(one)(*jax.tree.leaves((shared, jax.tree.map(lambda leaf: leaf[k], items))))
            return [lax.dynamic_update_index_in_dim(into, value, k, 0) for into, value in zip(found, results, strict=True)]

        nothing = [jnp.zeros((len(numbers), *form.shape), form.dtype) for form in forms]
        return jax.tree.unflatten(structure, lax.fori_loop(0, jnp.sum(numbers < count, dtype=jnp.int32), step, nothing))

    devices, n = mesh.devices.size, jax.tree.leaves(items)[0].shape[0]
    if devices == 1:
        return the_first(shared, items, jnp.arange(n, dtype=jnp.int32), count)
    around = jax.sharding.get_abstract_mesh()
    if AxisType.Explicit in around.axis_types:
        dealt_out: Any = jax.sharding.auto_axes(functools.partial(map_first, mesh, fun), out_sharding=P(mesh.axis_names))
        return dealt_out(shared, items, count)
    turns = _turns(n, devices)

    def on_one(shared: Any, items: Any, numbers: Any, count: Any) -> Any:
        return the_first(shared, jax.tree.map(lambda leaf: leaf[0], items), numbers[0], count)

    over = jax.shard_map(
        on_one,
        mesh=mesh if around.empty else around,
        in_specs=(P(), P(mesh.axis_names), P(mesh.axis_names), P()),
        out_specs=P(mesh.axis_names),
        check_vma=False,
    )
    return over(shared, jax.tree.map(lambda leaf: leaf[turns], items), turns.astype(np.int32), count)


def _turns(n: int, devices: int) -> np.ndarray:
    """Which items each device has; the last one is given out again, until each has as many."""
    count = math.ceil(n / devices)
    return np.minimum(np.arange(count * devices), n - 1).reshape(count, devices).T


def over_spread(mesh: Mesh, fun: Callable[[Any, Any], Any], shared: Any, items: Spread) -> Any:
    """`fun(shared, part)` for the part that each device has. Results have parts along the same axis, and each device gets all.

    Derivatives with respect to `shared` are sums over devices.
    """
    if mesh.devices.size == 1:
        return fun(shared, items.values)
    around = jax.sharding.get_abstract_mesh()
    given, parts = mesh if around.empty else around, P(None, mesh.axis_names)
    over = jax.shard_map(fun, mesh=given, in_specs=(P(), parts), out_specs=parts, check_vma=False)
    whole = NamedSharding(given, P())
    return jax.tree.map(lambda leaf: lax.with_sharding_constraint(leaf, whole), over(shared, items.values))
