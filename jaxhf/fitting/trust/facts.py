"""What the last pictures of a fit say about it: gathered here, put into words by `words`."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from ...core.affine import Affine, affine
from ...scene.light import Point, Sky
from ...scene.scene import Scene
from ...trace.normals import vertex_normals
from ...xla.compilation import compiled
from ..given import Given
from ..model.expansion import Expansion, influence_function
from ..model.problem import Problem
from ..model.terms import octaves
from ..solve.noise import Freedom

_ALIKE = 0.3  # correlation of neighbouring residuals above which they are no noise
_LIKE_NOISE = 0.2  # below which they may be
_LEAST_PAIRS = 100  # from which it is taken
_LEAST_SIZE = 0.01  # of a picture's brightness: smaller residuals are rounding and other trifles
_FAR = 4.5  # times the median: three standard deviations of normal errors
_EXPLAINED = 0.5  # share of the squared residuals that a factor or an offset of the picture must explain
_TRIFLE = 0.1  # a factor or, over the brightness, an offset that is too small to be a cause
_RELATIVE = 1e-5  # above what single precision leaves of a sum that is 0; oblique pictures have 1e-3 to 0.2
_REFLECTANCE = "or the surface does not reflect as its material does (Matte is Lambert's law)"
_FAR_FROM_PRIOR = 2.5  # of its deviations, root mean square over an octave of its modes
_LEAST_MODES = 8  # in an octave
_LIKE_ONE = 0.5  # correlation of the channels' residuals
_OUTLIER = 4.0  # standard deviations
_LEAST_CHI2 = 0.5  # below which what is left is mostly the error of few samples, which all channels have
_MOST_UNKNOWNS = 0.25  # of the values, where it is not known how much of the noise is explained: it is told 13 % too small then
_MOST_EXPLAINED = 0.75  # of a picture's noise: one sun without a prior has 0.8, and 0.65 to 1 of its noise is found
_LEAST_SLOPE = 0.1  # of a robust loss, on average
_SAME_LIGHT, _SAME_VIEW = 3.0, 20.0  # degrees: from 5 and 20 on deviations held, docs/measurements/photometry.md
_WIDER = 1.2  # the spread of residuals over the noise, above which that may be larger


class Left(NamedTuple):
    """A picture as it would be measured, its target, and their difference in standard deviations of the noise, 0 where it does
    not count; which values depend on the heights; noise and brightness as in `Problem`."""

    image: Float[np.ndarray, "h w c"]
    target: Float[np.ndarray, "h w c"]
    residual: Float[np.ndarray, "h w c"]
    informing: Bool[np.ndarray, "h w c"]
    noise: float
    brightness: float


def left_of(expansion: Expansion) -> list[Left]:
    """What is left of each picture."""
    problem, groups = expansion.problem, expansion.problem.groups
    rows = expansion.pictures(), [group.targets for group in groups], [group.weights for group in groups], expansion.informing()
    images, targets, weights, informing = (problem.by_picture([np.asarray(part) for part in parts]) for parts in rows)
    pairs = zip(images, targets, weights, strict=True)
    off = [np.where(weight > 0, image - target, 0) * weight for image, target, weight in pairs]
    numbers = problem.noise.tolist(), problem.brightness.tolist()
    return list(map(Left, images, targets, off, informing, *numbers))


def neighbour_correlation(residual: Float[np.ndarray, "h w c"], counts: Bool[np.ndarray, "h w c"]) -> tuple[float, float]:
    """The correlation of the residuals of pixels side by side, about 0 where they are noise; and their root mean square.

    What is far off is left out: chi2 tells of it, and a robust loss has let it go. (0, 0) where too few count.
    """
    spread = float(np.median(np.abs(residual[counts]))) if counts.any() else 0.0
    counts = counts & (np.abs(residual) <= _FAR * spread)
    products, squares, pairs = 0.0, 0.0, 0
    for a, b in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        both = counts[a] & counts[b]
        one, other = residual[a][both].astype(np.float64), residual[b][both].astype(np.float64)
        products, squares, pairs = products + one @ other, squares + (one @ one + other @ other) / 2, pairs + len(one)
    if pairs < _LEAST_PAIRS or squares == 0:
        return 0.0, 0.0
    return float(products / squares), float(np.sqrt(squares / pairs))


def unlike_noise(pictures: Sequence[Left], given: Given) -> str | None:
    """What is left of pictures although it is no noise, in words; None: nothing. An estimate of the noise takes it for noise,
    and chi2 is about 1."""
    found = []
    for number, left in enumerate(pictures):
        alike, spread = neighbour_correlation(left.residual, left.informing)
        size = spread * left.noise / left.brightness
        if alike > _ALIKE and size > _LEAST_SIZE:
            found.append((size * alike, size, alike, number))
    if not found:
        return None
    _, size, alike, worst = max(found)
    several = "" if len(found) == 1 else f" and of {len(found) - 1} more"
    return (
        f"what is left of picture {worst}{several} is no noise: neighbouring pixels are off alike (correlation {alike:.2f}), "
        f"by {size:.0%} of its brightness; {_cause(pictures[worst], given)}"
    )


def dependent_channels(pictures: Sequence[Left]) -> str | None:
    """Which picture's channels are off alike, such as those of a grey photograph that was tinted; None: no picture's."""
    for number, left in enumerate(pictures):
        if left.residual.shape[-1] == 1:
            continue
        kept = left.informing.all(axis=-1) & (np.abs(left.residual) < _OUTLIER).all(axis=-1)
        values = left.residual[kept].astype(np.float64)
        if len(values) < _LEAST_PAIRS or np.mean(values**2) < _LEAST_CHI2:
            continue
        alike = (np.mean(values.sum(axis=-1) ** 2) / np.mean(np.sum(values**2, axis=-1)) - 1) / (values.shape[-1] - 1)
        if alike > _LIKE_ONE:
            return (
                f"the channels of picture {number} are off alike (correlation {alike:.2f}), so they are hardly more than one "
                "measurement, and standard deviations are too small, up to 1.7 times: give their mean, of shape (h, w)"
            )
    return None


def _cause(left: Left, given: Given) -> str:
    image, target = (values[left.informing].astype(np.float64) for values in (left.image, left.target))
    factor, offset = float(image @ target / max(image @ image, 1e-30)), float(np.mean(target - image))
    most = (1 - _EXPLAINED) * np.sum((target - image) ** 2)
    scaled, moved = np.sum((target - factor * image) ** 2), np.sum((target - image - offset) ** 2)
    if not given.unknown.offsets and moved < min(most, scaled) and abs(offset) > _TRIFLE * left.brightness:
        unknown = "Unknown(offsets=True) finds what haze or the sensor adds"
        return f"it is brighter than the scene by {offset:.3g}: {unknown}; {_REFLECTANCE}"
    if not given.unknown.exposures and factor > 0 and scaled < most and abs(factor - 1) > _TRIFLE:
        return (
            f"it is {factor:.3g} times as bright as the scene: Unknown(exposures=True) finds such factors, if the exposure, "
            f"the light or the albedo is not known; {_REFLECTANCE}"
        )
    prior = "" if given.prior is None else "the prior's std may be too small, or "
    if given.prior is not None and given.prior.length is not None:
        prior = "the prior's std may be too small or its length too long, or "
    off = "lights, cameras or the albedo may be off: Unknown(light_std=, camera_std=, albedo=) lets the fit find them"
    return f"{prior}{off}; {_REFLECTANCE}"


def boundary_places(expansion: Expansion) -> list[tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"] | None]]:
    """The pixels of each picture at the terrain's border and at silhouettes, and those at the edges of shadows.

    Where a fit takes no points on edges the latter are None, and the others are what does not depend on the heights, be it
    background or in shadow.
    """
    found = []
    for group, known in zip(expansion.problem.groups, expansion.linearised, strict=True):
        n, h, w, _ = group.targets.shape
        if known is None:
            found.append([(np.zeros((h, w), bool), None)] * n)
        elif known.edges is None:
            found.append([(shaded, None) for shaded in ~np.asarray(known.depends)])
        else:
            edges = zip(np.asarray(known.edges.pixel), np.asarray(known.edges.kind), strict=True)
            counts = [[np.bincount(pixel[kind == which], minlength=h * w) for which in (1, 2)] for pixel, kind in edges]
            found.append([tuple(count.reshape(h, w) > 0 for count in both) for both in counts])
    return expansion.problem.by_picture(found)


def on_boundaries(expansion: Expansion) -> list[Bool[np.ndarray, "n h w c"]]:
    """Which values of the pictures are of pixels that a boundary crosses."""
    masks = []
    for group, known in zip(expansion.problem.groups, expansion.linearised, strict=True):
        mask = np.zeros(group.targets.shape, bool)
        if known is not None and known.edges is not None:
            for picture, pixels in zip(mask, np.asarray(known.edges.resampled), strict=True):
                picture.reshape(-1, picture.shape[-1])[pixels] = True
        masks.append(mask)
    return masks


def what_may_help(expansion: Expansion, pictures: Sequence[Left], given: Given) -> str:
    """The one option to try where pictures are left unexplained."""
    problem = expansion.problem
    if given.noise is not None and all(map(_is_wider_noise, pictures)):
        return "what is left looks like noise that is larger than the given one: leave noise out, and the fit estimates it"
    if not problem.settings.shadows:
        return "Settings(shadows=True), the default, renders shadows, too"
    if given.settings.edge_samples == 0:
        return "Settings(edge_samples=None), the default, lets the fit move silhouettes, shadows and the terrain's border"
    if (share := _share_of_normals(expansion)) > 1:
        return (
            f"pictures of terrain as rough as this differ by {share:.2g} times the noise between normals weighted by area, the "
            "default, and by angle, as by Mitsuba: for those, Settings(normals='six-angle')"
        )
    if (problem.settings.samples or 1) < 16:
        return (
            "Settings(samples=16) makes pictures of finer samples; if that changes nothing, Unknown(camera_std=) finds a "
            "camera that is off, or mask those pixels by weights"
        )
    return (
        "mask those pixels by weights, if the scene cannot show what is there (clouds, trees, another albedo, a surface that "
        "does not reflect as its material does)"
    )


def _is_wider_noise(left: Left) -> bool:
    alike, spread = neighbour_correlation(left.residual, left.informing)
    return spread > _WIDER and abs(alike) < _LIKE_NOISE


def _share_of_normals(expansion: Expansion) -> float:
    """By about how much pictures change, in units of the noise, as normals are weighted by angle, not by area: the horizontal
    part of what they turn by times the pictures' brightness; 0 where the settings are not the default ones."""
    problem = expansion.problem
    if problem.settings.normals not in (None, "six") or problem.settings.shading != "smooth":
        return 0.0
    field = problem.field
    area, angle = (np.asarray(n, np.float64) for n in _by_area_and_angle(expansion.heights, field.dx, field.dy))
    horizontal = (angle - area / np.linalg.norm(area, axis=-1, keepdims=True))[..., :2]
    return float(np.sqrt(np.mean(np.square(horizontal))) * np.median(problem.brightness / problem.noise))


@functools.partial(compiled, static_argnames=("dx", "dy"))
def _by_area_and_angle(heights: Float[jax.Array, "ny nx"], dx: float, dy: float) -> list[Float[jax.Array, "ny nx 3"]]:
    return [vertex_normals(heights, dx, dy, scheme) for scheme in ("six", "six-angle")]


def strayed(problem: Problem, heights: np.ndarray, seen: np.ndarray, given: Given) -> float | None:
    """By how many of its deviations the heights that are seen differ from the prior, root mean square; None: there is none."""
    if given.prior is None:
        return None
    std = np.broadcast_to(np.asarray(given.prior.std, np.float64), heights.shape)
    counted = seen & (std > 0)
    off = (heights - np.asarray(problem.basis.crop(np.asarray(problem.terms.surface.mean))))[counted] / std[counted]
    return float(np.sqrt(np.mean(off**2))) if off.size else None


def misfit_of_length(problem: Problem, given: Given) -> str | None:
    """In which waves heights differ from a correlated prior by far more than its deviations, in words; None: in none."""
    length = None if given.prior is None else given.prior.length
    if length is None:
        return None
    basis, term = problem.basis, problem.terms.surface
    weight, spectrum = (np.asarray(values, np.float64) for values in (term.weight, term.spectrum))
    off = weight * (np.asarray(basis.base, np.float64) - np.asarray(term.mean, np.float64))
    modes = spectrum * (np.asarray(basis.rows, np.float64) @ off @ np.asarray(basis.columns, np.float64).T)
    bands = octaves(modes.shape).argmax(axis=0).ravel()
    counts = np.bincount(bands)
    sizes = np.sqrt(np.bincount(bands, (modes**2).ravel()) / counts)
    worst = int(np.argmax(np.where(counts >= _LEAST_MODES, sizes, 0)))
    if sizes[worst] < _FAR_FROM_PRIOR:
        return None
    cell = min(problem.field.dx, problem.field.dy)
    shortest = 2 * cell * 2**worst
    kind = "short" if sizes[worst] > 2 * sizes[max(worst - 2, 0)] else "long"  # it is waves of all lengths that are off then
    return (
        f"in waves of {shortest:.3g} to {2 * shortest:.3g} the heights differ from the prior by {sizes[worst]:.2g} times its "
        f"deviations there: its length, {length:.6g} or {length / cell:.3g} cells, may be too {kind}, or its std too "
        f"small. The length is in the unit of dx and dy, of which a cell has {cell:.6g}, not in cells"
    )


def shows_mean(gradients: Float[np.ndarray, "k ny nx"]) -> bool:
    """Whether pictures change as all heights move up together; orthophotos do not. The sums of `random_gradients` are normal,
    with the deviation |J 1|."""
    sums = gradients.sum(axis=(1, 2))
    return float(np.linalg.norm(sums)) > _RELATIVE * float(np.linalg.norm(gradients))


def have_same_light(scenes: Sequence[Scene]) -> bool:
    """Whether light comes from about one direction in all pictures: that of their light vectors."""
    return _are_within(_SAME_LIGHT, [_light_vector(scene) for scene in scenes])


def have_same_view(scenes: Sequence[Scene]) -> bool:
    """Whether all pictures show the terrain from about one direction."""
    vectors = []
    for scene in scenes:
        world, middle = _terrain(scene)
        eye, at_place = scene.camera.viewpoint()
        vectors.append(np.linalg.solve(world.linear, np.asarray(eye, np.float64) - (middle if at_place else 0)))
    return _are_within(_SAME_VIEW, vectors)


def _are_within(degrees: float, vectors: Sequence[Float[np.ndarray, "3"]]) -> bool:
    directions = np.array([vector / max(float(np.linalg.norm(vector)), 1e-30) for vector in vectors])
    return bool(np.min(directions @ directions.T) >= np.cos(np.radians(degrees)))


def _terrain(scene: Scene) -> tuple[Affine, Float[np.ndarray, "3"]]:
    """Where the first heightfield lies, and its middle in the world."""
    place, field = scene.objects[scene.first_heightfield].world_from_object, scene.heightfields[0]
    matrix: Any = np.eye(4) if place is None else np.asarray(place, np.float64)
    world = affine(matrix)
    y, x = (step * (n - 1) / 2 for n, step in zip(field.heights.shape, (field.dy, field.dx), strict=True))
    middle: Any = np.array([field.x0 + x, field.y0 + y, np.mean(np.asarray(field.heights, np.float64))])
    return world, np.asarray(world.point(middle))


def _light_vector(scene: Scene) -> Float[np.ndarray, "3"]:
    """The sum of what each light sends to the middle of the first heightfield, as a vector towards it, in that one's frame
    (Gershun, The light field, 1939); a surface by Lambert's law is as bright as under one light from there, but for shadows
    and, under a sky, for what it adds everywhere."""
    (world, middle), total = _terrain(scene), np.zeros(3)
    for light in scene.lights:
        if isinstance(light, Sky):
            towards, power = np.array([0.0, 0.0, 1.0]), np.pi / 2 * np.asarray(light.radiance, np.float64)
        elif isinstance(light, Point):
            towards = np.asarray(light.p, np.float64) - middle
            power = np.asarray(light.intensity, np.float64) / max(float(towards @ towards), 1e-30)
        else:
            towards, power = np.asarray(light.towards, np.float64), np.asarray(light.irradiance, np.float64)
        total += np.mean(power) * towards / max(float(np.linalg.norm(towards)), 1e-30)
    return np.linalg.solve(world.linear, total)


def why_noise_is_unsure(problem: Problem, unknowns: int, freedom: Freedom | None) -> str | None:
    """Why an estimate of the noise beside so many unknown numbers may be too small, in words; None: it is sure."""
    if freedom is not None:
        worst = int(np.argmax(freedom.explained))
        if freedom.explained[worst] <= _MOST_EXPLAINED:
            return None
        return f"heights explain {freedom.explained[worst]:.0%} of the noise of picture {worst}: what is left hardly tells it"
    share = unknowns / problem.values
    if share <= _MOST_UNKNOWNS:
        return None
    return f"there are {share:.2g} unknowns to each value of the pictures, which explain an unknown part of its noise"


def chi_squared(
    problem: Problem, residuals: Float[np.ndarray, " n"], counts: Sequence[int], freedom: Freedom | None
) -> tuple[float, float | None]:
    """The mean square of residuals by degree of freedom, about 1 where they are noise; and the mean of `Freedom.free`.

    A value that a robust loss lets go takes no part in the fit, so heights explain none of it, and its residual r is larger
    than by least squares. With ψ = ρ', v the mean of ψ' and h the share that least squares explain, r + h / (1 - h) ψ / v is
    about its residual from the fit to all other values; times 1 - h, that has the size of the residual by least squares (Cook
    and Weisberg, Residuals and influence in regression, 1982, section 2.2).

    `counts`: how many of the residuals each picture has. Without `freedom` heights are few, and explain nothing of the noise.
    """
    if residuals.size == 0 or freedom is None:
        return (float(np.mean(residuals**2)) if residuals.size else 0.0), None
    psi, slope, _ = influence_function(residuals, problem.loss_scale)
    explained, free = (np.repeat(values, counts) for values in (freedom.explained, freedom.free))
    left = residuals + explained * (psi / max(np.mean(slope), _LEAST_SLOPE) - residuals)
    return float(np.sum(left**2) / np.sum(free)), float(np.mean(free))
