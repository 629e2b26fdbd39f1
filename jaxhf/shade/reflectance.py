"""What the surface that was hit sends on of the light that reaches it."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..core.types import Flag, Scalar, Vector
from ..core.vector import dot, greater, quotient, select
from ..preparation.world import World
from ..scene.material import Material, Matte, map_textures
from ..trace.hit import Hit

# Directions in which a sky is looked at: Gauss's nodes along the sine of the altitude, and even steps of the azimuth.
_ALTITUDES, _AZIMUTHS = 8, 8


def has_material(world: World, hit: Hit, kind: type) -> Flag:
    """Whether the hit lies on an object of this kind of material."""
    flags = [isinstance(material, kind) for material in world.materials]
    if all(flags):
        return hit.object >= 0
    found = jnp.zeros((), bool)
    for number, flag in enumerate(flags):
        found = found | (hit.object == number) if flag else found
    return found


def depends_on_view(world: World) -> bool:
    """Whether anything that scatters light does so by another law than `Matte`, which asks for no directions."""
    return any(isinstance(material, Material) and type(material).brdf is not Matte.brdf for material in world.materials)


def matte_albedo(world: World, hit: Hit) -> Vector:
    """That of the object which was hit, where all that scatters light is `Matte`."""
    mattes = ((number, m) for number, m in enumerate(world.materials) if isinstance(m, Matte))
    return select(hit.object, [(number, _at(m, hit).albedo) for number, m in mattes])


def brdf(world: World, wi: Vector, wo: Vector, hit: Hit) -> Vector:
    """That of the object which was hit, for light from a direction; whatever where that scatters none."""
    n = hit.ns * hit.side.astype(hit.ns.dtype)
    values = (
        (number, jnp.broadcast_to(_at(m, hit).brdf(wi, wo, n), (3,)))
        for number, m in enumerate(world.materials)
        if isinstance(m, Material)
    )
    return select(hit.object, values)


def brdf_under_sky(world: World, wo: Vector, hit: Hit) -> Vector:
    """The mean BRDF over the upper half space, weighted by the cosine of incidence.

    By quadrature over fixed directions, as weights that fall to 0 at the surface's own horizon have no jumps there.
    """
    sines, weights = np.polynomial.legendre.leggauss(_ALTITUDES)
    sines, weights = (sines + 1) / 2, np.repeat(weights, _AZIMUTHS)
    azimuths = (np.arange(_AZIMUTHS) + 0.5) * (2 * np.pi / _AZIMUTHS)
    level = np.sqrt(1 - sines**2)[:, None]
    nodes = [level * np.cos(azimuths), level * np.sin(azimuths), np.repeat(sines[:, None], _AZIMUTHS, axis=1)]
    dtype = hit.ns.dtype
    n = hit.ns * hit.side.astype(dtype)

    def look(seen: tuple[Vector, Scalar], node: tuple[Vector, Scalar]) -> tuple[tuple[Vector, Scalar], None]:
        (total, whole), (wi, weight) = seen, node
        cosine = dot(wi, n)
        weight = weight * greater(cosine, jnp.zeros_like(cosine))
        return (total + weight * brdf(world, wi, wo, hit), whole + weight), None

    given = jnp.asarray(np.stack(nodes, axis=-1).reshape(-1, 3), dtype), jnp.asarray(weights, dtype)
    (total, whole), _ = lax.scan(look, (jnp.zeros(3, dtype), jnp.zeros((), dtype)), given)
    return quotient(total, jnp.where(whole > 0, whole, 1))


def _at(material: Material, hit: Hit) -> Any:
    """A material as it is at the hit: without textures."""
    return jax.tree.map(jnp.asarray, map_textures(material, lambda image: image(hit.uv)))
