"""What a fit minimises, but for the unknowns: pictures with their noise, priors, and how to render."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Float

from ...core.errors import ArgumentError
from ...core.precision import numbers
from ...core.settings import Settings
from ...scene.heightfield import Heightfield
from ...scene.light import Sky
from ...scene.scene import Scene
from ...scene.texture import ImageTexture
from ...xla.compilation import compiled
from ...xla.devices import chosen_mesh
from ..given import NOISE_RULE, Given, Unknown
from .pictures import Group, albedo_of, choose_edge_samples, choose_samples, make_groups
from .terms import AlbedoField, Terms, by_mode, make_albedo_field, make_terms, prior_std
from .unknowns import Basis, Unknowns, View, make_basis, make_heights, pad, padding, slope_units, sun, with_seam

LOSS_SCALE = 3.0  # standard deviations from which on the robust loss makes less of a residual, in the end
_FIRST_NOISE = 0.01  # of a picture's brightness, where none is given
_DARK = 0.03  # of a picture's brightness: what lies in shadow
_DARK_SHARE = 0.003  # of its pixels
_LEAST_NOISE = 5e-4  # of it: about the rounding of a picture with 8 bits


class Problem(eqx.Module):
    """All that the loss depends on beside the unknowns; nothing of it changes but by making another one.

    Attributes:
      groups: the pictures.
      basis: from DCT coefficients to heights; another for each stage.
      loss_scale: the size, in standard deviations, above which a residual counts less; changes with the stage.
      noise: standard deviation of each picture's values at weight 1, by which the groups' weights are divided.
      brightness: of each picture, the value that 1 % of it exceeds.
      bright: the unit of `Unknowns.offsets`, radiance.
      view_unit: of the numbers of `Unknowns.view`, radians and world units, shapes (2,) and (6,).
      field: the heightfield that is sought, for its size and spacing.
      albedo: the prior of an albedo whose factors are not independent; None: there is none such.
      albedo_shape: of `Unknowns.albedo`.
      known: whether its heights have a prior of the user's.
    """

    groups: tuple[Group, ...]
    basis: Basis
    terms: Terms
    loss_scale: Float[Array, ""]
    noise: Float[np.ndarray, " pictures"]
    brightness: Float[np.ndarray, " pictures"]
    bright: Float[Array, ""]
    view_unit: View
    field: Heightfield
    albedo: AlbedoField | None
    albedo_shape: tuple[int, ...] | None = eqx.field(static=True)
    settings: Settings = eqx.field(static=True)
    mesh: Mesh = eqx.field(static=True)
    known: bool = eqx.field(static=True)

    def factors(self, unknowns: Unknowns) -> Float[Array, "ty tx c"] | None:
        """What the albedo is multiplied by; None where it is known."""
        return unknowns.albedo if self.albedo is None or unknowns.albedo is None else self.albedo.factors(unknowns.albedo)

    def moves(self, unknowns: Unknowns, group: Group) -> View:
        """By what the light and the camera of each picture of a group are `moved`."""
        which = np.array(group.indices)  # what pictures share has one row for all
        return jax.tree.map(lambda values, unit: values[which % len(values)] * unit[None], unknowns.view, self.view_unit)

    @property
    def least_noise(self) -> Float[np.ndarray, " pictures"]:
        """Below which no estimate of the noise may fall."""
        return _LEAST_NOISE * self.brightness

    @property
    def count(self) -> int:
        """How many pictures there are."""
        return sum(len(group.indices) for group in self.groups)

    @property
    def values(self) -> int:
        """How many values of pictures count."""
        return sum(int(np.count_nonzero(np.asarray(group.given))) for group in self.groups)

    def by_picture(self, rows: Sequence[Any]) -> list[Any]:
        """What each picture has in an array for each group, in the order of the caller's pictures."""
        pairs = zip(self.groups, rows, strict=True)
        found = {k: part for group, row in pairs for k, part in zip(group.indices, row, strict=True)}
        return [found[k] for k in range(self.count)]

    def edge_samples_for(self, heights: Float[Array, "ny nx"], settings: Settings) -> int:
        """As many points on edges as pictures of these heights call for, if the user's settings leave that open.

        Where there were some, others are taken only if it calls for four times as many: steps are then compiled again.
        """
        before = self.settings.edge_samples
        if settings.edge_samples is not None:
            return settings.edge_samples
        views = [
            group.complete(jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k], group.scenes), heights)
            for group in self.groups
            for k in range(len(group.indices))
        ]
        dark = self.settings.shadows and any(_shadows_in(group) for group in self.groups)
        count = choose_edge_samples(views, self.settings, dark)
        return before if before and count < 4 * before else count

    def widened(self, widths: Float[np.ndarray, " octaves"]) -> "Problem":
        """The same problem with a prior of the heights whose modes have deviations that are so many times as large."""
        if (widths == 1).all():
            return self
        spectrum = self.terms.surface.spectrum
        wider = np.asarray(np.asarray(spectrum) / by_mode(widths, spectrum.shape), spectrum.dtype)
        return eqx.tree_at(lambda problem: problem.terms.surface.spectrum, self, jnp.asarray(wider))

    def with_edge_samples(self, count: int) -> "Problem":
        return dataclasses.replace(self, settings=dataclasses.replace(self.settings, edge_samples=count))

    def with_noise(
        self, noise: Float[np.ndarray, " pictures"], sampling: Sequence[Float[np.ndarray, "n h w"] | None] | None = None
    ) -> "Problem":
        """The same problem with another standard deviation of each picture's values at weight 1.

        To it comes the error of the pictures' samples, of each group; None: it is not known, and does not count.
        """
        groups = []
        for number, group in enumerate(self.groups):
            # By NumPy: each operation of JAX's would be a program to compile.
            given = np.asarray(group.given)
            variance = group.each(noise).astype(given.dtype) ** 2
            variance = variance / np.where(given > 0, given, 1) ** 2
            if sampling is not None and sampling[number] is not None:
                variance = variance + np.asarray(sampling[number])[..., None] ** 2
            weights = np.where(given > 0, 1 / np.sqrt(variance), 0)
            groups.append(dataclasses.replace(group, weights=jnp.asarray(weights, given.dtype)))
        return dataclasses.replace(self, groups=tuple(groups), noise=noise)


def make_problem(scenes: Sequence[Scene], targets: Sequence[np.ndarray], given: Given) -> tuple[Problem, Unknowns]:
    """The problem, and the unknowns from which a fit starts; targets, weights and noise are those of `checked_pictures`.
    ArgumentError where scenes, targets and arguments do not belong together."""
    first = scenes[0]
    field, dtype = first.heightfields[0], first.heights.dtype
    prior, held = given.prior, np.zeros(field.heights.shape, bool)
    border = padding(field, None if prior is None else prior.length)

    def where_free() -> Float[np.ndarray, "my mx"] | None:
        """0 where heights are held so far, else 1; None: none are."""
        return pad((~held).astype(np.float64), border) if held.any() else None

    start = _without_holes(np.asarray(first.heights)) if given.start is None else given.start
    heights = make_heights("fit", "start", start, field)
    if prior is not None and not (std := prior_std(field, prior)).all():
        held = np.broadcast_to(std == 0, heights.shape)
        heights = np.where(held, make_heights("Prior", "heights", prior.heights, field), heights)
    if field.seam is not None:
        held, heights = held | np.isfinite(np.asarray(field.seam)).all(-1), with_seam(field, heights)
    counts = where_free()
    if prior is not None and prior.held is not None:
        known = _held_heights(prior.held, field)
        held, heights = held | np.isfinite(known), np.where(held | np.isnan(known), heights, known)
    base = pad(heights, border)
    basis = make_basis(field, base, slope_units(base.shape, field.dx, field.dy)[0], free=where_free())
    settings = choose_samples(scenes, given.settings)
    _require_shown(scenes, given.unknown)
    brightness, view_unit = _brightness(targets), _view_unit(scenes, given.unknown)
    assert given.weights is not None
    groups = make_groups(scenes, targets, given.weights, settings)
    unknowns = _first_unknowns(scenes, basis, max(group.targets.shape[-1] for group in groups), given.unknown, view_unit)
    albedo = _albedo_field(field, unknowns, given.unknown)
    problem = Problem(
        groups=groups,
        basis=basis,
        terms=make_terms(field, prior, given.unknown, base, counts, view_unit, albedo),
        loss_scale=jnp.asarray(LOSS_SCALE, dtype),
        noise=np.ones(len(scenes)),
        brightness=brightness,
        bright=jnp.asarray(np.median(brightness), dtype),
        view_unit=view_unit,
        field=Heightfield(field.heights, field.dx, field.dy),  # wherever it stands: other windows then share programs
        albedo=albedo,
        albedo_shape=None if unknowns.albedo is None else unknowns.albedo.shape,
        settings=settings,
        mesh=chosen_mesh("fit", given.mesh),
        known=prior is not None,
    ).with_noise(_noise(given.noise, brightness))
    return problem.with_edge_samples(problem.edge_samples_for(jnp.asarray(heights, dtype), given.settings)), unknowns


def _held_heights(held: Any, field: Heightfield) -> Float[np.ndarray, "ny nx"]:
    """ArgumentError where those of a prior have another shape than the heights, are infinite, or leave none to be sought."""
    known, shape = np.asarray(numbers(held), np.float64), field.heights.shape
    if known.shape != shape or np.isinf(known).any() or not np.isnan(known).any():
        rule = f"must be finite, nan where heights are sought, of shape {shape}, as the heights; its shape is {known.shape}"
        raise ArgumentError("Prior", "held", f"{rule}, {np.count_nonzero(np.isnan(known))} of them nan")
    return known


def _view_unit(scenes: Sequence[Scene], unknown: Unknown) -> View:
    """The units of what is sought of lights and cameras; ArgumentError where the camera may be farther off than the terrain is
    long, as by a deviation in another unit.

    A radian, and for cameras a quarter of the terrain: so they change pictures about as much as modes of one slope do. In units
    of deviations of 1 degree a light's columns of J were 20 to 40 times smaller, and a fit of 15 steps took 58 and stopped
    short.
    """
    field, camera = scenes[0].heightfields[0], None
    dtype = field.heights.dtype
    if unknown.camera_std is not None:
        side = max((n - 1) * d for n, d in zip(field.heights.shape, (field.dy, field.dx), strict=True))
        position = unknown.camera_std[0]
        if position > side:
            rule = (
                f"must have a position that is off by at most the terrain's longer side, {side:.6g}; it is {position:.6g}, or "
                f"{position / min(field.dx, field.dy):.3g} cells. It is in the unit of dx and dy"
            )
            raise ArgumentError("Unknown", "camera_std", rule)
        camera = jnp.asarray([side / 4] * 3 + [1 / 4] * 3, dtype)
    light = None if unknown.light_std is None else jnp.ones(2, dtype)
    sky = None if unknown.sky_std is None else jnp.ones(1, dtype)
    deviations = unknown.material_std or {}
    material = jnp.asarray([*deviations.values()], dtype) if deviations else None
    return View(light, camera, sky, material, tuple(deviations))


def _require_shown(scenes: Sequence[Scene], unknown: Unknown) -> None:
    """ArgumentError where a scene does not have the light or the numbers of a material that are sought."""
    for k, scene in enumerate(scenes):
        if unknown.light_std is not None and sun(scene.lights) is None:
            raise ArgumentError("Unknown", "light_std", f"must stand with Directional lights, scenes[{k}] has none")
        if unknown.sky_std is not None and not any(isinstance(light, Sky) for light in scene.lights):
            raise ArgumentError("Unknown", "sky_std", f"must stand with a Sky, scenes[{k}] has none")
        kind = scene.objects[scene.first_heightfield].material
        known = [field.name for field in dataclasses.fields(kind) if _is_number(getattr(kind, field.name))]
        for name in unknown.material_std or ():
            if name not in known:
                rule = f"must name numbers of the material of scenes[{k}], {type(kind).__name__}: {known}; it names {name!r}"
                rule += ", which is None: give it a number" if getattr(kind, name, known) is None else ""
                raise ArgumentError("Unknown", "material_std", rule)


def _is_number(leaf: Any) -> bool:
    return isinstance(leaf, np.ndarray | jax.Array) and leaf.shape == ()


def _albedo_field(field: Heightfield, unknowns: Unknowns, unknown: Unknown) -> AlbedoField | None:
    if unknowns.albedo is None or unknown.albedo_length is None:
        return None
    ny, nx = field.heights.shape
    side, shape = ((ny - 1) * field.dy, (nx - 1) * field.dx), unknowns.albedo.shape[:2]
    # The texels of an image end at the border, vertices stand on it.
    spacing = tuple(length / (n if n != count else n - 1) for length, n, count in zip(side, shape, (ny, nx), strict=True))
    return make_albedo_field(shape, spacing, unknown.albedo_std, unknown.albedo_length, field.heights.dtype)


def _without_holes(heights: Float[np.ndarray, "ny nx"]) -> Float[np.ndarray, "ny nx"]:
    """The first scene's heights, where a fit is to begin with them."""
    holes = np.argwhere(~np.isfinite(heights))
    if len(holes):
        iy, ix = holes[0]
        where = f"row {iy} column {ix} is {heights[iy, ix]}; fill them, or give a start without holes"
        raise ArgumentError("fit", "scenes[0]", f": the heights must have no holes where there is no start, {where}")
    return heights


def _shadows_in(group: Group) -> bool:
    """Whether pictures without a sky have dark places."""
    if any(isinstance(light, Sky) for light in group.scenes.lights):
        return False
    targets, counts = np.asarray(group.targets), np.asarray(group.given) > 0
    shares = [np.mean(t[c] < _DARK * np.percentile(t[c], 99)) for t, c in zip(targets, counts, strict=True)]
    return bool(max(shares) > _DARK_SHARE)


def _noise(given: Any, brightness: Float[np.ndarray, " pictures"]) -> Float[np.ndarray, " pictures"]:
    """The standard deviation of each picture's values; where none is given, one from which an estimate begins."""
    if given is None:
        return _FIRST_NOISE * brightness
    noise = np.asarray(numbers(given), np.float64)
    if noise.shape not in ((), brightness.shape) or not (np.isfinite(noise) & (noise > 0)).all():
        raise ArgumentError("fit", "noise", f"{NOISE_RULE}, it is {given!r}")
    return np.broadcast_to(noise, brightness.shape).copy()


def _brightness(targets: Sequence[np.ndarray]) -> Float[np.ndarray, " pictures"]:
    """Of each picture, the value that 1 % of it exceeds; 1 for a black one."""
    bright = [np.nanpercentile(np.asarray(target, np.float64), 99) for target in targets]
    return np.where(np.asarray(bright) > 0, bright, 1.0)


def _first_unknowns(scenes: Sequence[Scene], basis: Basis, channels: int, unknown: Unknown, view_unit: View) -> Unknowns:
    """Those from which a fit starts: coefficients 0, the albedo, lights and cameras of the scenes, exposure 1 and offset 0."""
    scene, count = scenes[0], len(scenes)
    shape, dtype, albedo = scene.heights.shape, scene.heights.dtype, None
    if unknown.albedo is not None:
        material = scene.objects[scene.first_heightfield].material
        known = albedo_of(material)
        if known is None:
            rule = f"is sought, so the heightfield's material must have an albedo; {type(material).__name__} has none"
            raise ArgumentError("Unknown", "albedo", rule)
        image = known.texels.shape[:2] if isinstance(known, ImageTexture) else shape
        shape = (*(image if unknown.albedo == "map" else (1, 1)), 1 if unknown.albedo_shared else channels)
        # By NumPy, as what follows: JAX's own ones and zeros are a program for each shape.
        albedo = jax.device_put(np.full(shape, 1 if unknown.albedo_length is None else 0, dtype))
    view = jax.tree.map(lambda unit: jax.device_put(np.zeros((count, unit.size), unit.dtype)), view_unit)
    if view.material is not None:  # which all pictures show
        view = dataclasses.replace(view, material=view.material[:1])
    return Unknowns(
        jax.device_put(np.zeros(basis.base.shape, dtype)),
        albedo,
        jax.device_put(np.ones(count, dtype)) if unknown.exposures else None,
        jax.device_put(np.zeros(count, dtype)) if unknown.offsets else None,
        view,
    )


@functools.partial(compiled, jit=eqx.filter_jit, newer=None)
def surface_of(unknowns: Unknowns, basis: Basis) -> Float[Array, "my mx"]:
    """The heights with their padding, by one program."""
    return basis.surface(unknowns.coefficients)
