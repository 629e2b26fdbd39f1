"""Arbitrary output variables: what a picture's rays met, besides their radiance."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from ..core.errors import ArgumentError
from ..core.ray import Ray
from ..preparation.world import World
from ..shade.lighting import in_shadow
from ..trace.hit import Hit

AOVS = ("depth", "normal", "uv", "status", "object", "cell", "shadow", "steps", "exhausted")
"""Arbitrary output variables, each (h, w) or (h, w, c), of the ray through the pixel's centre:

depth: distance to the hit, infinite where there is none. normal: shading normal, world frame. uv: position in the
footprint. status: see `Status`. object: its number in the scene, -1 for none. cell: (ix, iy), -1 for none. shadow: for each
light but the sky, whether it fails to reach the hit (blocked, or behind the surface). steps: taken by the search for the hit,
over all objects. exhausted: walks that ran out of steps, over all samples of the pixel, shadow and mirrored rays included.
"""


def known_aovs(owner: str, names: Any) -> tuple[str, ...]:
    """The names, if all are among `AOVS`; else an ArgumentError."""
    if isinstance(names, str) or names is None:
        raise ArgumentError(owner, "aovs", f"must be a list of names, as in aovs=('depth',); it is {names!r}")
    names = tuple(names)
    for name in names:
        if name not in AOVS:
            raise ArgumentError(owner, "aovs", f"must be among {', '.join(AOVS)}; one is {name!r}")
    return names


def observe(world: World, ray: Ray, hit: Hit, aovs: tuple[str, ...]) -> dict[str, jax.Array]:
    """Those of `aovs` that belong to one ray and its first hit: all but "exhausted"."""
    found = hit.object >= 0
    makers: dict[str, Callable[[], jax.Array]] = {
        "depth": lambda: jnp.where(found, hit.t if ray.before is None else hit.t + ray.before, jnp.inf),
        "normal": lambda: jnp.where(found, hit.ns, 0),
        "uv": lambda: jnp.where(found, hit.uv, 0),
        "status": lambda: hit.status,
        "object": lambda: hit.object,
        "cell": lambda: jnp.where(found, hit.cell, -1),
        "shadow": lambda: in_shadow(world, hit),
        "steps": lambda: jnp.asarray(hit.steps),
    }
    return {name: makers[name]() for name in aovs if name in makers}
