"""Arbitrary output variables."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from ..core.ray import Ray
from ..core.settings import Settings
from ..shade.lighting import in_shadow
from ..trace.world import World, first_vertex

AOVS = ("depth", "normal", "uv", "status", "object", "cell", "shadow", "steps", "exhausted")
"""Arbitrary output variables, each (h, w) or (h, w, c), of the ray through the pixel's centre:

depth: distance to the hit, infinite where there is none. normal: shading normal, world frame. uv: place in the
footprint. status: see `Status`. object: its number in the scene, -1 for none. cell: (ix, iy), -1 for none. shadow: for each
light but the sky, whether it fails to reach the hit (blocked, or behind the surface). steps: taken by the search for the hit,
over all objects. exhausted: walks that ran out of steps, over all samples of the pixel, shadow and mirrored rays included.
"""


def _observe(world: World, ray: Ray, settings: Settings, aovs: tuple[str, ...]) -> dict[str, jax.Array]:
    vertex = first_vertex(world, ray, settings, count_steps="steps" in aovs)
    hit, found = vertex.hit, vertex.index >= 0
    makers: dict[str, Callable[[], jax.Array]] = {
        "depth": lambda: jnp.where(found, hit.t, jnp.inf),
        "normal": lambda: jnp.where(found, hit.ns, 0),
        "uv": lambda: jnp.where(found, hit.uv, 0),
        "status": lambda: hit.status,
        "object": lambda: vertex.index,
        "cell": lambda: jnp.where(found, hit.cell, -1),
        "shadow": lambda: in_shadow(world, vertex, settings),
        "steps": lambda: jnp.asarray(hit.steps),
    }
    return {name: makers[name]() for name in aovs if name in makers}
