"""The pictures of a fit, checked and gathered into those that one program renders."""

import dataclasses
import functools
import math
import os
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...boundary.guiding import boundary_length
from ...core.errors import ArgumentError
from ...core.precision import numbers
from ...core.settings import Settings
from ...core.types import AnyArray, Scalar
from ...preparation.any_size import of_any_terrain
from ...preparation.localise import localise
from ...preparation.world import World, resolve_settings
from ...rendering.render import prepared_world
from ...scene.camera import of_any_size
from ...scene.light import Sky, Sun
from ...scene.material import Material, Mirror
from ...scene.scene import Scene
from ...scene.skirt import Skirt
from ...scene.texture import FlatTexture, ImageTexture
from ...shade.radiance import has_mirrors
from ...xla.compilation import compiled
from ..given import Noise, has_detector, noise_of_each
from .unknowns import KNOWN, View, with_numbers

_SAMPLES = 4  # a pixel, at least
EDGE_SAMPLES = (2048, 32768)
"""At least, at most."""
_EDGE_SAMPLES_PER_PIXEL = 8  # of a picture's boundaries


class Group(eqx.Module):
    """Pictures whose scenes differ in numbers only; they are rendered one after the other by one program.

    Attributes:
      scenes: what differs from picture to picture: a scene whose leaves have a leading axis of n pictures, None for the others.
      shared: those others, once for all pictures. The heights that are sought are None in both.
      targets: shape (n, h, w, c), c = 1 for grey.
      given: the user's weights, by which the noise is divided, zero where a value does not count, shape (n, h, w, c).
      weights: 1 / standard deviation of each value, zero where there is none, shape (n, h, w, c).
      indices: the pictures' positions among the caller's.
    """

    scenes: Scene
    shared: Scene
    targets: Float[Array, "n h w c"]
    given: Float[Array, "n h w c"]
    weights: Float[Array, "n h w c"]
    indices: tuple[int, ...] = eqx.field(static=True)

    def each(self, values: Any) -> Any:
        """A number for each of the caller's pictures, for each of these: shape (n, 1, 1, 1)."""
        stack = np.stack if isinstance(values, np.ndarray) else jnp.stack
        return stack([values[k] for k in self.indices]).reshape(-1, 1, 1, 1)

    def complete(
        self,
        scene: Scene,
        heights: Float[Array, "ny nx"],
        factors: Float[Array, "ty tx c"] | None = None,
        numbers: View = KNOWN,
    ) -> Scene:
        """One picture's leaves of `scenes`, with those that are shared, these heights, an albedo times these factors, and a
        material whose numbers are moved."""
        scene = with_material(_with_heights(eqx.combine(scene, self.shared), heights), numbers)
        return scene if factors is None else with_albedo(scene, factors)


def can_be_linearised(scene: Scene, settings: Settings) -> bool:
    """Whether each sample depends on one triangle alone: where no mirror shows another one, and none makes a penumbra.

    How much of a `Sky` with `occlusion` the terrain hides is taken as it is at each step, without its derivative: it changes
    slowly, and points on edges are worth more.
    """
    if any(isinstance(light, Sun) for light in scene.lights):
        return False
    return not has_mirrors((obj.material for obj in scene.objects), settings)


def checked_pictures(
    scenes: Sequence[Scene], targets: Sequence[Any], weights: Sequence[Any] | None, noise: Any
) -> tuple[tuple[np.ndarray, ...], list[Float[np.ndarray, "h w c"]], Any]:
    """Checks scenes, targets and weights; returns the targets with nan where they have no weight, as no statistic counts these,
    the weight of each of their values, and the noise at weight 1 in numbers.

    That of a `Noise` is the root mean square of its values' deviations; weights say by how much each differs from that.
    """
    count = len(scenes)
    if count == 0:
        raise ArgumentError("fit", "scenes", "must hold at least one Scene, it is empty")
    if len(targets) != count:
        raise ArgumentError("fit", "targets", f"must hold a picture for each of the {count} scenes, they are {len(targets)}")
    if weights is not None and len(weights) != count:
        raise ArgumentError("fit", "weights", f"must hold one for each of the {count} scenes, they are {len(weights)}")
    for k, scene in enumerate(scenes):
        _require_alike(k, scene, scenes[0])
    detectors = noise_of_each(noise, count) if has_detector(noise) else [None] * count
    kept, given, in_numbers = [], [], []
    for k, (scene, target, detector) in enumerate(zip(scenes, targets, detectors, strict=True)):
        values, weight = _checked_picture(k, scene, target, weights, detector)
        if isinstance(detector, Noise):
            weight, detector = _by_detector(detector, values, weight)
        kept.append(np.where(weight > 0, values, np.nan).reshape(np.shape(target)))
        given.append(weight)
        in_numbers.append(detector)
    return tuple(kept), given, np.array(in_numbers, np.float64) if has_detector(noise) else noise


def make_groups(
    scenes: Sequence[Scene], targets: Sequence[np.ndarray], weights: Sequence[np.ndarray], settings: Settings
) -> tuple[Group, ...]:
    """`checked_pictures`, those together that one program can render with these settings; their noise is 1."""
    found: dict[Any, list[tuple[int, Scene, Any, Any]]] = {}
    for k, (scene, *pair) in enumerate(zip(scenes, targets, weights, strict=True)):
        target, weight = _picture(*(values.reshape(*values.shape[:2], -1) for values in pair))
        local = _with_heights(localise(scene), None)
        leaves, structure = jax.tree.flatten(local)
        kind = structure, resolve_settings(settings, scene).samples, tuple(leaf.shape for leaf in leaves), target.shape
        found.setdefault(kind, []).append((k, local, target, weight))
    dtype, groups = scenes[0].heights.dtype, []
    for members in found.values():
        indices, views, *pictures = zip(*members, strict=True)
        target, given = (jnp.asarray(np.stack(values), dtype) for values in pictures)
        groups.append(Group(*_stacked(views), target, given, given, indices))
    return tuple(groups)


def _with_heights(scene: Scene, heights: Array | None) -> Scene:
    """`scene` over other heights of its first heightfield; None where they are to be filled in later."""
    return eqx.tree_at(lambda scene: scene.heightfields[0].heights, scene, heights, is_leaf=lambda leaf: leaf is None)


def with_material(scene: Scene, numbers: View) -> Scene:
    """The scene with numbers of its first heightfield's material moved."""
    if not numbers.names:
        return scene
    k = scene.first_heightfield
    material = with_numbers(scene.objects[k].material, numbers)
    return eqx.tree_at(lambda scene: scene.objects[k].material, scene, material)


def with_albedo(scene: Scene, factor: Float[Array, "ty tx c"]) -> Scene:
    """The scene with the albedo of its first heightfield multiplied."""
    k = scene.first_heightfield
    material = scene.objects[k].material
    old = albedo_of(material)
    texture = old if isinstance(old, ImageTexture) else ImageTexture(jnp.broadcast_to(jnp.asarray(old), (1, 1, 3)))
    shape = (*(max(pair) for pair in zip(texture.texels.shape[:2], factor.shape[:2], strict=True)), 3)
    new = jnp.broadcast_to(texture.texels, shape) * jnp.broadcast_to(factor, shape)
    albedo = new.reshape(3) if shape[:2] == (1, 1) and texture is not old else dataclasses.replace(texture, texels=new)
    return eqx.tree_at(lambda scene: scene.objects[k].material.albedo, scene, albedo)


def albedo_of(material: Material | Mirror) -> Float[AnyArray, "..."] | ImageTexture | FlatTexture | None:
    """The albedo to which what a material scatters is proportional; None where it has none."""
    return getattr(material, "albedo", None)


def _stacked(scenes: Sequence[Scene]) -> tuple[Scene, Scene]:
    """Cameras, lights and what else differs, stacked; and what all scenes share bit for bit: leaves are None in the other."""
    first = scenes[0]

    def same(leaf: Any, *others: Any) -> bool:
        return all(leaf is other or np.asarray(leaf).tobytes() == np.asarray(other).tobytes() for other in others)

    shared = jax.tree.map(same, *scenes)
    # A loop over pictures needs something to go through also where there is but one.
    views = jax.tree.map(lambda _: False, (first.camera, first.lights))
    shared = eqx.tree_at(lambda scene: (scene.camera, scene.lights), shared, views)
    stacked = jax.tree.map(
        lambda *leaves: jnp.asarray(np.stack(leaves)), *(eqx.filter(scene, shared, inverse=True) for scene in scenes)
    )
    return stacked, jax.tree.map(jnp.asarray, eqx.filter(first, shared))


def _require_alike(k: int, scene: Scene, first: Scene) -> None:
    """All scenes have the same first heightfield, but for the heights."""
    wrong = functools.partial(ArgumentError, "fit", f"scenes[{k}]")
    if not isinstance(scene, Scene):
        raise wrong(f"must be a Scene, it is a {type(scene).__name__}")
    if not scene.heightfields:
        raise wrong("must have a heightfield, there is none among its objects")
    field, other = scene.heightfields[0], first.heightfields[0]
    for name in ("shape", "dtype"):
        mine, theirs = getattr(field.heights, name), getattr(other.heights, name)
        if mine != theirs:
            raise wrong(f": the heights must have the {name} of the first scene's, {theirs}; it is {mine}")
    for name in ("dx", "dy", "x0", "y0"):
        mine, theirs = getattr(field, name), getattr(other, name)
        if mine != theirs:
            raise wrong(f": {name} must be that of the first scene's heightfield, {theirs}; it is {mine}")
    seams: Any = field.seam, other.seam
    if seams[0] is not seams[1] and not np.array_equal(*seams, equal_nan=True):
        raise wrong(": the seam must be that of the first scene's heightfield, it is another")


def _checked_picture(
    k: int, scene: Scene, target: Any, weights: Sequence[Any] | None, noise: Any
) -> tuple[Float[np.ndarray, "h w c"], Float[np.ndarray, "h w c"]]:
    """Target and weight of one picture; 0 where a `Noise` says that it is no measurement."""
    size = (scene.camera.height, scene.camera.width)
    wrong_target, wrong_weight = (functools.partial(ArgumentError, "fit", f"{name}[{k}]") for name in ("targets", "weights"))
    if isinstance(target, str | os.PathLike):
        raise wrong_target(f"must be an image, it is a name: jaxhf.load_image({os.fspath(target)!r})")
    given = np.asarray(target).dtype
    if given.kind not in "fV":  # the latter are bfloat16 and its like
        rule = f"must hold linear radiance in floats, 1 being white; it holds {given} (load_image decodes a picture)"
        raise wrong_target(rule)
    target = numbers(target).astype(np.float64)
    if target.shape not in (size, (*size, 1), (*size, 3)):
        raise wrong_target(f"must have shape {size} or {(*size, 3)}, as its camera says; it is {target.shape}")
    target = target.reshape(*size, -1)
    weight = np.ones(size) if weights is None or weights[k] is None else numbers(weights[k])
    if weight.dtype.kind not in "biuf":
        raise wrong_weight(f"must hold numbers, it holds {weight.dtype}")
    weight = weight.astype(np.float64)
    if weight.shape not in (size, target.shape):
        raise wrong_weight(f"must have shape {size}, its shape is {weight.shape}")
    if not np.isfinite(weight).all() or weight.min() < 0 or weight.max() == 0:
        raise wrong_weight(f"must be finite, from 0 on, not all 0; they are {weight.min()} to {weight.max()}")
    weight = np.broadcast_to(weight.reshape(*size, -1), target.shape)
    if isinstance(noise, Noise):
        weight = np.where(_is_measured(noise, target, given), weight, 0)
        if not weight.any():
            limits = f"saturation, {noise.saturation!r}, and other than nodata, {noise.nodata!r}"
            raise wrong_target(f"must have values with a weight that are below its Noise's {limits}; it has none")
    bad = ~np.isfinite(target) & (weight > 0)
    if bad.any():
        y, x, c = np.argwhere(bad)[0]
        where = f"row {y} column {x} channel {c} is {target[y, x, c]}"
        raise wrong_target(f"must be finite where it has a weight; {where}; a weight of 0 masks it")
    return target, weight


def _is_measured(noise: Noise, target: Float[np.ndarray, "h w c"], dtype: np.dtype) -> Bool[np.ndarray, "h w c"]:
    """Which values are neither saturated nor without data; those that divide them are rounded as the target was, to `dtype`."""
    found = np.ones(target.shape, bool)
    if noise.saturation is not None:
        found &= ~(target >= np.asarray(noise.saturation, dtype).astype(np.float64))
    if noise.nodata is not None:
        with np.errstate(over="ignore"):  # it is infinite then, and equals no value
            nodata = np.asarray(noise.nodata, dtype).astype(np.float64)
        found &= ~np.isnan(target) if np.isnan(nodata) else target != nodata
    return found


def _by_detector(
    noise: Noise, target: Float[np.ndarray, "h w c"], weight: Float[np.ndarray, "h w c"]
) -> tuple[Float[np.ndarray, "h w c"], float]:
    """The weight of each value of a picture by its noise, and its noise at weight 1."""
    counts = weight > 0
    variance = float(noise.read) ** 2 + float(noise.gain) * np.maximum(np.where(counts, target, 0), 0)
    mean = np.mean(variance[counts])
    return weight * np.sqrt(mean / variance), float(np.sqrt(mean))


def _picture(
    target: Float[np.ndarray, "h w c"], weight: Float[np.ndarray, "h w c"]
) -> tuple[Float[np.ndarray, "h w k"], Float[np.ndarray, "h w k"]]:
    """What is measured, and its weight; 0 where it has none. Equal channels are one measurement, stored three times."""
    told = target[(weight > 0).all(axis=-1)]
    if target.shape[-1] == 3 and np.all(told == told[:, :1]) and np.all(weight == weight[..., :1]):
        target, weight = target[..., :1], weight[..., :1]
    return np.where(weight > 0, target, 0), weight


def vertex_values(world: World) -> Float[jax.Array, "vertices n"]:
    """Heights and, with smooth shading, the normals' components, of the first heightfield."""
    _, grid, _ = world.grids[0]
    heights = grid.rows[:, None]
    return heights if grid.normals is None else jnp.concatenate([heights, grid.normals], axis=1)


def choose_samples(scenes: Sequence[Scene], settings: Settings) -> Settings:
    """The settings with the samples a pixel that they leave open: at least four, or more if a scene asks for them."""
    if settings.samples is not None:
        return settings
    asked = max(resolve_settings(settings, scene).samples or 1 for scene in scenes)
    return dataclasses.replace(settings, samples=max(_SAMPLES, asked))


def choose_edge_samples(views: Sequence[Scene], settings: Settings, shadows: bool = False) -> int:
    """As many points on edges as the longest boundaries in one of these `localise`d pictures ask for; 0 where there are none,
    and beside a skirt. A power of two, so that pictures that differ little share a program.

    `shadows`: whether the measured pictures show shadows, whatever these scenes do.
    """
    has_skirt = any(isinstance(obj.shape, Skirt) for view in views for obj in view.objects)  # with points it is refused
    if has_skirt or not all(can_be_linearised(view, settings) for view in views):
        return 0
    length = max(float(_boundary_length(view, settings)) for view in views)
    least, most = EDGE_SAMPLES
    if length == 0:
        return least if shadows else 0
    return min(max(2 ** round(math.log2(_EDGE_SAMPLES_PER_PIXEL * length)), least), most)


def _boundary_length(scene: Scene, settings: Settings) -> Scalar:
    """By programs for terrains and pictures of any size."""
    if scene.sky_occlusion is not None:  # which takes long to find, and bounds nothing
        scene = scene.with_lights([light for light in scene.lights if not isinstance(light, Sky)])
    settings = dataclasses.replace(resolve_settings(settings, scene), samples=1, edge_samples=0)
    return _length_for_any_size(of_any_terrain(prepared_world(scene, settings)), of_any_size(scene.camera))


_length_for_any_size = compiled(boundary_length)
