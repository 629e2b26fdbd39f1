"""Which triangle does a ray meet? A discrete search: integers come out, which carry no derivative."""

import operator
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import UInt32

from ..core.ray import Ray
from ..core.types import Flag, Index, Scalar
from ..xla.kernel import in_parts
from .grid import Grid, first_places, put_at
from .hit import Hit
from .walk import Walk, WalkResult, walking
from .walk_start import walk_start


def first_triangle(
    grid: Grid,
    ray: Ray,
    *,
    active: Flag | None = None,
    leaving: Hit | None = None,
    number: int = 0,
    t_max: Scalar | None = None,
    count_steps: bool = False,
) -> WalkResult:
    """The first triangle in which `ray` meets the surface.

    With one level of bounds this is the walk of Amanatides and Woo (A fast voxel traversal algorithm, Eurographics 1987), with
    the distance to each crossing recomputed from the integer cell, as a running sum drifts; with all levels, that of Tevs
    et al. (I3D 2008) over their maximum mipmaps. The loop has a fixed budget of steps, each of which skips up to two blocks and
    visits one cell: the grid's `most_steps`. Derivatives begin at the hit, see `surface_hit` in `intersect.py`.

    Args:
      grid: the surface.
      ray: in the grid's frame; may start outside the footprint, or below the surface.
      active: False spares a ray the walk: it ends as a miss.
      leaving: for a ray that starts from a hit. If that lies on this grid, the ray leaves its triangle on the hit's `side` and
        cannot meet it again; this replaces the usual offset by an epsilon.
      number: of the grid's object, as in `Hit.object`.
      t_max: where to give up; a hit beyond it may or may not be reported.
      count_steps: whether to count the steps.
    """
    grid, ray, leaving, t_max = lax.stop_gradient((grid, ray, leaving, t_max))
    walk, state, valid = walk_start(grid, ray, leaving, number, t_max, active)
    state, steps = _search(walk, state, count_steps, grid.fixed_steps)
    return walk.finish(state, valid, steps)


# Blocks of cells that are looked at between two visits to cells.
SKIPS = 2


def _search(walk: Walk, state: jax.Array, count: bool, fixed_steps: int | None) -> tuple[jax.Array, Index | None]:
    """The state in which a walk ends, and the number of its steps if they are to be counted.

    Under `vmap` the steps are repeated until the last walk of the batch has ended. JAX's own rule for `while_loop` would
    count the steps of each ray and keep the state of an ended walk by a selection; `Walk` does both by itself, so that this
    rule leaves them out (without it a frame takes 1.06 to 1.09 of the time).
    """
    one = _search_many(jax.tree.map(lambda _: False, walk), count, fixed_steps)
    return jax.tree.map(lambda leaf: leaf[0], one(walk, state[None]))


def _search_many(of_ray: Walk, count: bool, fixed_steps: int | None) -> Callable[[Walk, jax.Array], Any]:
    """`_search` for a batch of walks, of which `of_ray` says which leaves differ from one to the other.

    Under a further `vmap`, as over heightfields each with rays of its own, all become one batch, and grids one array: a loop
    in a loop's batch took three times as long.
    """

    def together(own: tuple[Walk, jax.Array], shared: Walk) -> Any:
        batched, state = own
        skip = jax.vmap(lambda batched, state: eqx.combine(batched, shared).skip(state))
        visit = jax.vmap(lambda batched, state: eqx.combine(batched, shared).visit(state))

        def advance(carry):
            state, steps = carry
            if steps is not None:
                steps = steps + walking(state).astype(jnp.int32)
            state = lax.fori_loop(0, SKIPS, lambda _, state: skip(batched, state), state)
            return visit(batched, state), steps

        steps = jnp.zeros(state.shape, jnp.int32) if count else None
        budget = jnp.max(eqx.combine(batched, shared).budget)  # of grids of one shape it is the same
        return until_ended(advance, (state, steps), budget, fixed_steps)

    @jax.custom_batching.custom_vmap
    def run(walk: Walk, state: jax.Array):
        batched, shared = eqx.partition(walk, of_ray)
        return in_parts(together, (batched, state), shared)

    @run.def_vmap
    def run_more(axis_size: int, in_batched, walk: Walk, state: jax.Array):
        rays = state.shape[-1]
        flat, differs = _one_batch(walk, of_ray, in_batched[0], axis_size, rays)
        state = jnp.broadcast_to(state, (axis_size, rays)).reshape(-1)
        ended = _search_many(differs, count, fixed_steps)(flat, state)
        return jax.tree.map(lambda leaf: leaf.reshape(axis_size, rays), ended), jax.tree.map(lambda _: True, ended)

    return run


def _one_batch(walk: Walk, of_ray: Walk, of_batch: Walk, axis_size: int, rays: int) -> tuple[Walk, Walk]:
    """The walks of several batches as those of one, and which leaves differ from walk to walk.

    Args:
      walk: a leaf has an axis for the batch, where `of_batch` says so, and then one for the ray, where `of_ray` does.
      of_ray, of_batch: walks whose leaves are bool.
      axis_size: batches.
      rays: in each.
    """

    def flattened(leaf: jax.Array, per_ray: Any, per_batch: Any) -> jax.Array:
        if not (per_ray or per_batch):
            return leaf
        leaf = leaf if per_batch else leaf[None]
        leaf = leaf if per_ray else leaf[:, None]
        return jnp.broadcast_to(leaf, (axis_size, rays, *leaf.shape[2:])).reshape(-1, *leaf.shape[2:])

    flat, differs = jax.tree.map(flattened, walk, of_ray, of_batch), jax.tree.map(operator.or_, of_ray, of_batch)
    for part in (lambda walk: (walk.rows, walk.first), lambda walk: (walk.pyramid.bounds, walk.pyramid.first)):
        if part(of_batch)[0] and not part(of_ray)[0]:  # all grids in one array
            values, first = part(walk)[0], part(flat)[1]
            begin = jnp.repeat(first_places(values), rays)
            joined = values.reshape(-1), begin if first is None else begin + first
            flat, differs = put_at(part, flat, joined), put_at(part, differs, (False, True))
    return flat, differs


def until_ended(advance: Callable[[Any], Any], carry: Any, budget: Index, fixed_steps: int | None) -> Any:
    """What a walk carries, `advance`d until it has ended, or `budget` times; with `fixed_steps` so many times, always.

    The first part of `carry` is the state of a walk, or of a batch, where the last one counts.
    """
    if fixed_steps is not None:
        return lax.fori_loop(0, fixed_steps, lambda _, carry: advance(carry), carry)

    def going(counted):
        step, (state, *_) = counted
        return (step < budget) & _any_walking(state)

    return lax.while_loop(going, lambda counted: (counted[0] + 1, advance(counted[1])), (jnp.zeros((), jnp.int32), carry))[1]


def _any_walking(state: UInt32[jax.Array, "*rays"]) -> Flag:
    """Whether a walk, or one of several, goes on. Halves of the states are put together bit by bit first, in vectors: the bit
    that says so is then set where it is in one of them. XLA's `any` would take flag after flag."""
    while state.ndim == 1 and state.size % 2 == 0 and state.size > 8:
        state = state[: state.size // 2] | state[state.size // 2 :]
    return walking(state).any()
