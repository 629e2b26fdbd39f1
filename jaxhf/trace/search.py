"""Which triangle does a ray meet? A discrete search: integers come out, which carry no derivative."""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Int, UInt32

from ..core.ray import Ray
from ..core.types import Flag, Index, Scalar
from .grid import Grid
from .walk import CellHit, Walk, walking
from .walk_start import Departure, begin

Step = Callable[[jax.Array], jax.Array]


# Blocks of cells that are looked at between two visits to cells.
_SKIPS = 2


def march(walk: Walk, state: jax.Array, budget: int, count: bool) -> tuple[jax.Array, Index | None]:
    """The state in which a walk ends, and the number of its steps if they are to be counted.

    Under `vmap` walks go on until the last of them has ended. This has a rule of its own, as that of `while_loop` would count
    the steps of each ray, and keep an ended one's state by a selection, both of which `Walk` does by itself.
    """

    @jax.custom_batching.custom_vmap
    def run(walk: Walk, state: jax.Array):
        return _until_done(walk.skip, walk.visit, state, budget, count)

    @run.def_vmap
    def run_many(axis_size: int, in_batched, walk: Walk, state: jax.Array):
        lanes, shared = eqx.partition(walk, in_batched[0])
        state = state if in_batched[1] else jnp.broadcast_to(state, (axis_size,))
        skip = jax.vmap(lambda lanes, state: eqx.combine(lanes, shared).skip(state))
        visit = jax.vmap(lambda lanes, state: eqx.combine(lanes, shared).visit(state))
        ended = _until_done(lambda state: skip(lanes, state), lambda state: visit(lanes, state), state, budget, count)
        return ended, jax.tree.map(lambda _: True, ended)

    return run(walk, state)


def _until_done(
    skip: Step, visit: Step, state: UInt32[jax.Array, "*lanes"], budget: int, count: bool
) -> tuple[UInt32[jax.Array, "*lanes"], Int[jax.Array, "*lanes"] | None]:
    """Steps, each of which passes a few blocks and visits one cell, of one ray or of several."""

    def going(carry):
        step, state, _ = carry
        return (step < budget) & walking(state).any()

    def advance(carry):
        step, state, steps = carry
        if steps is not None:
            steps = steps + walking(state).astype(jnp.int32)
        state = lax.fori_loop(0, _SKIPS, lambda _, state: skip(state), state)
        return step + 1, visit(state), steps

    none = jnp.zeros((), jnp.int32)
    steps = jnp.zeros(state.shape, jnp.int32) if count else None
    _, state, steps = lax.while_loop(going, advance, (none, state, steps))
    return state, steps


def first_hit(
    grid: Grid,
    ray: Ray,
    *,
    max_steps: int | None,
    active: Flag | None = None,
    departure: Departure | None = None,
    t_max: Scalar | None = None,
    count_steps: bool = False,
) -> CellHit:
    """Finds the first triangle in which `ray` meets the surface.

    With one level of bounds this is the walk of Amanatides and Woo (A fast voxel traversal algorithm, Eurographics 1987), with
    the distance to each crossing recomputed from the integer cell, as a running sum drifts; with all levels, that of Tevs
    et al. (I3D 2008) over their maximum mipmaps. It has a fixed number of steps and ends early. It is discrete
    and carries no gradient; see `surface_interaction`.

    Args:
      grid: the surface.
      ray: in the grid's frame; may start outside the footprint, or below the surface.
      max_steps: the most steps, in each of which up to two blocks are passed and one cell is visited; None: `enough_steps`.
      active: False spares a ray the walk: it ends as a miss.
      departure: for rays that leave this surface.
      t_max: where to give up; a hit beyond it may or may not be reported.
      count_steps: whether to count the steps.
    """
    grid, ray, departure, t_max = lax.stop_gradient((grid, ray, departure, t_max))
    walk, state, valid = begin(grid, ray, departure, t_max, active)
    bound = enough_steps(grid)
    state, steps = march(walk, state, bound if max_steps is None else min(max_steps, bound), count_steps)
    return walk.finish(state, valid, steps)


def enough_steps(grid: Grid) -> int:
    """A number of steps that suffices for any ray.

    A ray moves one way along each axis, so on each level it passes through at most (blocks along x) + (blocks along y) - 1
    blocks. It comes to each of them at most once: it grows to a block only on entering it, and goes down into one
    only from the block around it. Each step deals with at least one of them.
    """
    cells_x, cells_y = grid.cells
    levels = range(grid.pyramid.levels + 1)
    return sum(math.ceil(cells_x / 2**level) + math.ceil(cells_y / 2**level) - 1 for level in levels)
