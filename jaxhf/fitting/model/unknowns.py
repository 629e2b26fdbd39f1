"""What a fit varies: the DCT modes of a surface, lights and cameras about those that were given, and what else is unknown."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jax import lax
from jaxtyping import Array, Bool, Float

from ...core.affine import affine
from ...core.errors import ArgumentError
from ...core.precision import numbers, require_fit
from ...core.types import Vector
from ...core.vector import dot, unit
from ...scene.camera import Camera
from ...scene.heightfield import Heightfield
from ...scene.light import Directional, Light, Sky
from ...scene.scene import Scene

# The height of a terrain's longest modes, as a share of the footprint's longer side. A mode's height falls as 1 / frequency
# from there: as modes of one slope do.
_STEEPNESS = 0.25


class View(eqx.Module):
    """What stands for each number of a light's direction and of a camera's pose, and for what all pictures see alike; None for
    what is known.

    Attributes:
      light: two angles by which the first directional light is turned, about axes across it, radians (their tangents).
      camera: by how much the eye is moved, world units, and a rotation vector about it, radians, both along the world's axes.
      sky: by how much the logarithm of the sky's radiance grows.
      material: by how much numbers of the first heightfield's material grow, and their names.
    """

    light: Float[jax.Array, "..."] | None = None
    camera: Float[jax.Array, "..."] | None = None
    sky: Float[jax.Array, "..."] | None = None
    material: Float[jax.Array, "..."] | None = None
    names: tuple[str, ...] = eqx.field(static=True, default=())


KNOWN = View()


class Unknowns(eqx.Module):
    """What a fit varies; None for what is known.

    Attributes:
      coefficients: of the DCT modes that are added to `Basis.base`, in units of `Basis.scale`, shape (my, mx): that of the
        heights, or more, see `Basis.padding`.
      albedo: a factor for each texel of the albedo (or for all of them: (1, 1)) in each channel (or for all of them: c = 1),
        shape (ty, tx, c); or the modes of their logarithms, see `AlbedoField`.
      exposures: a factor for each picture, shape (pictures,).
      offsets: added to each picture, in units of `Problem.bright`, shape (pictures,).
      view: how far the light and the camera of each picture are moved, in units of `Problem.view_unit`, shapes (pictures, 2)
        and (pictures, 6).
    """

    coefficients: Float[Array, "my mx"]
    albedo: Float[Array, "ty tx c"] | None = None
    exposures: Float[Array, " pictures"] | None = None
    offsets: Float[Array, " pictures"] | None = None
    view: View = KNOWN

    def at_base(self) -> "Unknowns":
        """The same but for the modes, which are 0: those of a surface that has become the base."""
        return self.with_modes(jax.device_put(np.zeros(self.coefficients.shape, self.coefficients.dtype)))

    def with_modes(self, coefficients: Any) -> Any:
        return eqx.tree_at(lambda u: u.coefficients, self, coefficients, is_leaf=lambda leaf: leaf is None)

    def without_modes(self) -> Any:
        """All but the coefficients, which are None."""
        return self.with_modes(None)

    @property
    def count(self) -> int:
        return sum(leaf.size for leaf in jax.tree.leaves(self))


class Window(NamedTuple):
    """Heights of a terrain: ny rows from row y on, nx columns from column x on."""

    y: int
    x: int
    ny: int
    nx: int

    @property
    def place(self) -> tuple[slice, slice]:
        return slice(self.y, self.y + self.ny), slice(self.x, self.x + self.nx)

    def rim(self, shape: tuple[int, ...], depth: int) -> Bool[np.ndarray, "ny nx"]:
        """Where it is at most so many vertices from a side beyond which a terrain of that shape goes on."""
        found = np.zeros((self.ny, self.nx), bool)
        found[:depth] |= self.y > 0
        found[self.ny - depth :] |= self.y + self.ny < shape[0]
        found[:, :depth] |= self.x > 0
        found[:, self.nx - depth :] |= self.x + self.nx < shape[1]
        return found


class Basis(eqx.Module):
    """A surface as `base` plus a sum of DCT-II modes (products of two cosines), each in a unit of its own.

    Shading sees slopes, so modes of one slope change a picture by as much, whatever their wavelength: in units of one slope
    the linear problems are well conditioned, and neighbouring heights move together. That is preconditioning by smoothness as
    in Nicolet et al., Large steps in inverse rendering of geometry (2021), whose (I + λL)⁻¹ is diagonal here, with the power
    that fits shading. `balanced` goes further (Jacobi's preconditioner): units in which the loss has the same curvature
    along every mode.

    The normal derivative of every mode is zero at the edge of the grid. Where that would constrain the heights too much (a
    prior with correlated errors), the grid is padded on each side by vertices that no picture shows.

    Attributes:
      rows, columns: the orthonormal DCT-II matrices of the two axes, a cosine in each row, shapes (my, my) and (mx, mx).
      scale: the height of a mode whose coefficient is 1; zero for modes that are not varied, shape (my, mx).
      base: the surface where all coefficients are zero, shape (my, mx).
      free: 0 where heights are held, else 1, shape (my, mx); None: all are free.
      padding: vertices beyond the terrain on each side: (my - ny) / 2 and (mx - nx) / 2.
    """

    rows: Float[Array, "my my"]
    columns: Float[Array, "mx mx"]
    scale: Float[Array, "my mx"]
    base: Float[Array, "my mx"]
    free: Float[Array, "my mx"] | None
    padding: tuple[int, int] = eqx.field(static=True)

    def heights(self, coefficients: Float[Array, "my mx"]) -> Float[Array, "ny nx"]:
        return self.crop(self.surface(coefficients))

    def surface(self, coefficients: Float[Array, "my mx"]) -> Float[Array, "my mx"]:
        """The heights with their padding."""
        change = self.synthesis(self.scale * coefficients)
        return self.base + (change if self.free is None else self.free * change)

    def crop(self, values: Any) -> Any:
        """An array of shape (my, mx) without its padding, shape (ny, nx)."""
        y, x = self.padding
        my, mx = values.shape
        return values[y : my - y, x : mx - x]

    # Products of matrices, not jax.scipy.fft: in single precision, two cores, one transform and its transpose take 0.02, 0.22,
    # 2.1 and 5.5 ms at 32², 128², 256² and 512², by idctn 0.04, 0.57, 4.8 and 10.8 ms. The FFT rounds to 2e-7 of the largest
    # value, the products to 1e-6, both far below what steps are solved to.
    def synthesis(self, modes: Float[Array, "my mx"]) -> Float[Array, "my mx"]:
        """The sum of modes, of unit length each."""
        return _product(self.rows.T, _product(modes, self.columns))

    def analysis(self, values: Float[Array, "my mx"]) -> Float[Array, "my mx"]:
        """The orthonormal DCT-II of `values`, the inverse of `synthesis`."""
        return _product(self.rows, _product(values, self.columns.T))


def _product(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.matmul(a, b, precision=lax.Precision.HIGHEST)


def slope_units(shape: tuple[int, ...], dx: float, dy: float) -> tuple[Float[np.ndarray, "my mx"], Float[np.ndarray, "my mx"]]:
    """The height of each mode of one slope, in a surface of this shape and spacing, and its frequency: how many half periods
    fit into the longer side."""
    ny, nx = shape
    longest = max((ny - 1) * dy, (nx - 1) * dx)
    along = [np.arange(n) * (longest / ((n - 1) * d)) for n, d in ((ny, dy), (nx, dx))]
    frequency = np.hypot(along[0][:, None], along[1][None, :])
    return _STEEPNESS * longest * np.sqrt(ny * nx) / (1 + frequency), frequency


def make_basis(
    field: Heightfield,
    base: Float[np.ndarray, "my mx"],
    units: Float[np.ndarray, "my mx"],
    cutoff: float = 1.0,
    free: Any = None,
) -> Basis:
    """The modes up to a share `cutoff` of the highest frequency about `base`, which may be padded; without the mean of all
    heights, unless the share is 1. `units`: the height of each mode whose coefficient is 1; `free`: see `Basis`."""
    (ny, nx), dtype = base.shape, field.heights.dtype
    padding = ((ny - field.heights.shape[0]) // 2, (nx - field.heights.shape[1]) // 2)
    varied = (np.arange(ny)[:, None] < max(2, cutoff * ny)) & (np.arange(nx)[None, :] < max(2, cutoff * nx))
    # The mean height shows only in how far things shift and grow in the picture: while high frequencies are left out, what
    # they leave unexplained would be taken for it (0.5 of the footprint in a case of 0.1 relief).
    varied[0, 0] = cutoff >= 1
    rows, columns = (jnp.asarray(dct_matrix(n), dtype) for n in (ny, nx))
    free = None if free is None else jnp.asarray(free, dtype)
    return Basis(rows, columns, jnp.asarray(units * varied, dtype), jnp.asarray(base, dtype), free, padding)


def padding(field: Heightfield, length: float | None) -> tuple[int, int]:
    """How many vertices to add beyond each border, in y and in x: one correlation length, at most half of the terrain's size.

    DCT modes have no slope across the edge of their grid, and errors across it are mirrored: at distance zero if the grid
    ended at the border, at two lengths with this padding. Matérn's correlation has its inflection at 0 to 2 lengths, beyond
    which slopes are no longer correlated; so the slopes at the border are free. The errors themselves are correlated over
    longer distances (Lindgren, Rue and Lindström, 2011, A.4), but more padding costs more steps.
    """
    if length is None:
        return 0, 0
    y, x = (min(math.ceil(length / d), n // 2) for n, d in zip(field.heights.shape, (field.dy, field.dx), strict=True))
    return y, x


def pad(values: Float[np.ndarray, "ny nx"], padding: tuple[int, int]) -> Float[np.ndarray, "my mx"]:
    """`values` with their border repeated on each side."""
    return np.pad(values, [(n, n) for n in padding], mode="edge")


def dct_matrix(n: int) -> Float[np.ndarray, "n n"]:
    """The orthonormal DCT-II of n values: a cosine in each row, from the constant one up."""
    k = np.arange(n)
    matrix = np.sqrt(2 / n) * np.cos(np.pi / n * k[:, None] * (k[None, :] + 0.5))
    matrix[0] /= np.sqrt(2)
    return matrix


def laplacian(shape: tuple[int, ...], spacing: Sequence[float]) -> Float[np.ndarray, "my mx"]:
    """The eigenvalue of each DCT mode for minus the Laplacian, by second differences over this spacing (y, x)."""
    y, x = [(2 - 2 * np.cos(np.pi * np.arange(n) / n)) / d**2 for n, d in zip(shape, spacing, strict=True)]
    return y[:, None] + x[None, :]


def make_heights(owner: str, name: str, value: Any, field: Heightfield) -> Float[np.ndarray, "ny nx"]:
    """Heights at the vertices of `field` from a number (flat), or from a grid of any size over the same footprint."""
    shape = field.heights.shape
    heights = np.array(numbers(value), np.float64)
    if heights.shape == ():
        heights = np.full(shape, heights)
    if heights.ndim != 2 or min(heights.shape) < 2:
        raise ArgumentError(owner, name, f"must be a number or heights of at least 2x2, its shape is {heights.shape}")
    if not np.isfinite(heights).all():
        iy, ix = np.argwhere(~np.isfinite(heights))[0]
        raise ArgumentError(owner, name, f"must be finite, row {iy} column {ix} is {heights[iy, ix]}")
    require_fit(heights, field.heights.dtype, owner, name)
    return heights if heights.shape == shape else resample(heights, shape)


def with_seam(field: Heightfield, heights: Float[np.ndarray, "ny nx"]) -> Float[np.ndarray, "ny nx"]:
    """Heights with those of the field where its surface goes on in another one, which a fit holds."""
    if field.seam is None:
        return heights
    return np.where(np.isfinite(np.asarray(field.seam)).all(-1), np.asarray(field.heights), heights)


def resample(heights: Float[np.ndarray, "my mx"], shape: tuple[int, ...]) -> Float[np.ndarray, "ny nx"]:
    """The bilinear surface through a grid over the same footprint, at the vertices of another grid."""
    for count in shape:  # rows and then columns, which each turn makes rows
        heights = (interpolation(np.linspace(0, len(heights) - 1, count), len(heights)) @ heights).T
    return heights


def interpolation(at: Float[np.ndarray, " m"], count: int) -> Any:
    """The sparse matrix that takes so many values in a row to those at places between them, linearly."""
    low = np.minimum(at.astype(int), count - 2)
    entries = np.concatenate([1 - (at - low), at - low])
    places = np.tile(np.arange(at.size), 2), np.concatenate([low, low + 1])
    return scipy.sparse.csr_array((entries, places), shape=(at.size, count))


def sun(lights: Sequence[Light]) -> Directional | None:
    """The first directional light; None where there is none."""
    return next((light for light in lights if isinstance(light, Directional)), None)


def moved(lights: tuple[Light, ...], camera: Camera, view: View) -> tuple[tuple[Light, ...], Camera]:
    """The light turned, the camera moved and the sky brighter by `view`, leaves (2,), (6,) and (1,); where these are zero, the
    same to the bit."""
    if view.light is not None:
        light = sun(lights)
        assert light is not None
        first, second = _across(light.towards)
        towards = light.towards + view.light[0] * first + view.light[1] * second
        lights = tuple(dataclasses.replace(light, towards=towards) if other is light else other for other in lights)
    if view.sky is not None:
        times = jnp.exp(view.sky[0])
        lights = tuple(_brighter(light, times) if isinstance(light, Sky) else light for light in lights)
    if view.camera is not None:
        world = affine(jnp.asarray(camera.world_from_camera))
        # Cayley's transform, of half the angle's tangent: for the angle itself that has no singular derivative at zero, and
        # a rotation of a degree is a degree to 3e-5 of it.
        q = view.camera[3:] / 2
        factor = 2 / (1 + dot(q, q))
        columns = []
        for k in range(3):
            column = jnp.cross(q, world.linear[:, k])
            columns.append(world.linear[:, k] + factor * (column + jnp.cross(q, column)))
        moved_by = view.camera[:3]
        if camera._ahead is not None:  # the eye is so far behind the place of the matrix
            moved_by = moved_by + camera._ahead * (columns[2] - world.linear[:, 2])
        columns.append(world.offset + moved_by)
        matrix = jnp.asarray(camera.world_from_camera).at[:3].set(jnp.stack(columns, axis=1))
        camera = eqx.tree_at(lambda camera: camera.world_from_camera, camera, matrix)
    return lights, camera


def moved_each(scenes: Scene, view: View) -> Scene:
    """Stacked scenes with their lights and cameras `moved`."""
    if not jax.tree.leaves(view):
        return scenes
    found = lax.map(lambda seen: moved(*seen), (scenes.lights, scenes.camera, view))
    return eqx.tree_at(lambda scenes: (scenes.lights, scenes.camera), scenes, found)


def _brighter(sky: Sky, times: Any) -> Sky:
    return dataclasses.replace(sky, radiance=times * jnp.asarray(sky.radiance))


def with_numbers(material: Any, view: View, given: tuple[Any, ...] | None = None) -> Any:
    """A material with the numbers that `view` seeks moved by it; `given`: from these, in the order of their names."""
    changes = () if view.material is None else view.material
    for name, number, change in zip(view.names, given or numbers_of(material, view), changes, strict=True):
        moved_number = jnp.asarray(number) + change
        material = eqx.tree_at(lambda material, name=name: getattr(material, name), material, moved_number)
    return material


def numbers_of(material: Any, view: View) -> tuple[Any, ...]:
    """The numbers of a material that `view` seeks."""
    return tuple(getattr(material, name) for name in view.names)


def differences(scene: Scene, other: Scene) -> tuple[float, float, float]:
    """Between two scenes: the angle of their first directional lights, degrees (nan where there is none); the distance of
    their cameras, world units, and the angle by which these are turned, degrees."""
    first, second, angle = sun(scene.lights), sun(other.lights), np.nan
    if first is not None and second is not None:
        a, b = (np.asarray(light.towards, np.float64) for light in (first, second))
        angle = np.arctan2(np.linalg.norm(np.cross(a, b)), np.dot(a, b))
    a, b = (np.asarray(each.camera.world_from_camera, np.float64) for each in (scene, other))
    turn = b[:3, :3] @ np.linalg.inv(a[:3, :3])
    sine = np.linalg.norm([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    rotation = np.arctan2(sine, np.trace(turn) - 1)
    return float(np.degrees(angle)), float(np.linalg.norm(b[:3, 3] - a[:3, 3])), float(np.degrees(rotation))


def _across(towards: Any) -> tuple[Vector, Vector]:
    """Two vectors across `towards` and each other, of its length."""
    towards = jnp.asarray(towards)
    axis = jnp.where(jnp.abs(towards[0]) < jnp.abs(towards[1]), jnp.array([1, 0, 0]), jnp.array([0, 1, 0]))
    first = unit(jnp.cross(towards, axis.astype(towards.dtype)))
    size = jnp.sqrt(dot(towards, towards))
    return size * first, jnp.cross(towards, first)
