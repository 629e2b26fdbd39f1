"""What a fit is made of, piece by piece: priors, losses, modes and stages; and what is refused before anything is traced."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.fft
import scipy.special
from small_fits import SETTINGS, SIZE, TRUTH, given as given_with, pictures, posed, scenes

import jaxhf
from jaxhf.core.errors import ArgumentError
from jaxhf.fitting import fit as _fit
from jaxhf.fitting.fit import coarser, factors
from jaxhf.fitting.model.expansion import influence_function, prior_residuals, soften
from jaxhf.fitting.model.pictures import with_albedo
from jaxhf.fitting.model.problem import Problem
from jaxhf.fitting.model.terms import make_terms
from jaxhf.fitting.model.unknowns import View, make_basis, resample, slope_units
from jaxhf.fitting.solve.stages import _balanced_units, stages
from jaxhf.preparation.localise import localise


def basis_of(field: jaxhf.Heightfield, base: np.ndarray, cutoff: float = 1.0):
    return make_basis(field, base, slope_units(base.shape, field.dx, field.dy)[0], cutoff)


def test_what_is_known_beforehand_counts_in_standard_deviations():
    """The prior at each height in modes of length 1, factors about 1, offsets about 0, and angles in degrees."""
    unknown = jaxhf.Unknown(albedo="constant", albedo_std=0.5, exposures=True, offsets=True, light_std=2.0)
    problem, unknowns = posed(scenes(TRUTH), pictures(), given_with(prior=jaxhf.Prior(TRUTH - 1, 4.0), unknown=unknown))
    light = jnp.full((3, 2), np.float32(np.radians(1.0)))
    moved = dataclasses.replace(
        unknowns, albedo=jnp.full((1, 1, 1), 1.5), exposures=jnp.full(3, 1.1), offsets=jnp.full(3, 0.2), view=View(light)
    )
    surface, albedo, exposures, offsets, lights = prior_residuals(moved, problem)
    np.testing.assert_allclose(problem.basis.synthesis(surface), 1 / 4, rtol=1e-5)
    for residual, expected in ((albedo, 1), (exposures, 0.1), (offsets, 0.2), (lights, 0.5)):
        np.testing.assert_allclose(residual, expected, rtol=1e-5)


def test_heights_are_held_where_the_surface_goes_on():
    """On the seam and the ring beyond it, as they are in the scene, whatever the start and the prior say there."""
    fine = jaxhf.Heightfield(TRUTH, 0.1)
    field, around = jaxhf.nested(fine, jaxhf.Heightfield(np.full((12, 12), 0.05), 0.3, x0=-1.2, y0=-1.2))
    objects = [jaxhf.Object(field), jaxhf.Object(around)]
    within = [dataclasses.replace(scene, objects=objects) for scene in scenes()]
    ring = np.ones((12, 12), bool)
    ring[2:-2, 2:-2] = False
    for prior in (None, jaxhf.Prior(0.2, 0.1)):
        problem, unknowns = posed(within, pictures(), given_with(start=0.3, prior=prior))
        assert problem.basis.free is not None
        np.testing.assert_array_equal(problem.basis.free, ~ring)
        found = problem.basis.heights(jnp.ones_like(unknowns.coefficients))
        np.testing.assert_array_equal(found[ring], field.heights[ring])
        assert (np.abs(problem.basis.base[~ring] - 0.3) < 1e-6).all()


def test_without_a_prior_long_waves_may_be_high():
    """All heights together by a quarter of the longer side, and waves by less, as 1 / (1 + frequency)²."""
    field, start = jaxhf.Heightfield(np.zeros((9, 13)), dx=0.5, dy=0.5), np.full((9, 13), 2.0)
    term = make_terms(field, None, jaxhf.Unknown(), start, None, View(), None).surface
    wave = np.sqrt(2) * np.cos(np.pi * 3 * (np.arange(13) + 0.5) / 13) * np.ones((9, 1))  # of mean square 1
    for heights, place in ((start + 6 / 4, (0, 0)), (start + 6 / 4 / (1 + 3) ** 2 * wave, (0, 3))):
        residuals = np.array(term.of_surface(jnp.zeros((9, 13)), basis_of(field, heights)))
        assert residuals[place] == pytest.approx(1, rel=1e-5)
        residuals[place] = 0
        np.testing.assert_allclose(residuals, 0, atol=1e-3)  # rounding, in units of a hundredth for the shortest


def test_errors_of_a_prior_are_correlated_as_whittle_said():
    """Its covariance as a matrix: prior_std at every vertex, and between two of them by the distance in world units."""
    ny, nx, std = 25, 31, np.linspace(1, 3, 25 * 31).reshape(25, 31)
    field = jaxhf.Heightfield(np.zeros((ny, nx)), dx=0.5, dy=1.0)
    term = make_terms(field, jaxhf.Prior(0.0, std, 3.0), jaxhf.Unknown(), np.zeros((ny, nx)), None, View(), None).surface
    basis = basis_of(field, np.asarray(term.mean, np.float64))
    still = jnp.zeros(term.mean.shape)
    rows = jax.jacfwd(lambda modes: term.of_surface(modes, basis))(still).reshape(still.size, -1)
    heights = jax.jacfwd(basis.heights)(still).reshape(ny * nx, -1)
    root = np.asarray(heights, np.float64) @ np.linalg.inv(np.asarray(rows, np.float64))
    covariance = root @ root.T
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), std.ravel(), rtol=1e-4)
    correlation = (covariance / np.outer(std, std)).reshape(ny, nx, ny, nx)[12, 15]
    y, x = np.mgrid[:ny, :nx] - np.array([12, 15]).reshape(2, 1, 1)
    r = np.hypot(y, x / 2) / 3
    r[12, 15] = 1e-9
    # The kernel is that of a plane without cells.
    np.testing.assert_allclose(correlation, r * scipy.special.k1(r), atol=0.04)
    # The border is a place like any other: mirrored there, errors would be level.
    across = covariance.reshape(ny, nx, ny, nx) / (std[:, :, None, None] * std)
    slope = [across[y, 15, y, 15] + across[y + 1, 15, y + 1, 15] - 2 * across[y, 15, y + 1, 15] for y in (0, 12, 23)]
    np.testing.assert_allclose(slope, slope[1], rtol=0.15)


@pytest.mark.parametrize("lies", [{"at_vertices": True}, {"wrap": "clamp"}], ids=str)
def test_a_sought_albedo_lies_as_its_texture(lies):
    texels = np.random.default_rng(0).uniform(0.2, 0.9, (4, 5, 3)).astype(np.float32)
    given, expected = (scenes(albedo=jaxhf.ImageTexture(np.float32(factor) * texels, **lies))[0] for factor in (1, 2))
    found = with_albedo(given, jnp.full((4, 5, 1), 2.0))
    assert eqx.tree_equal(localise(found), localise(expected), typematch=False)


@pytest.mark.parametrize("factors", [(1, 1, 1), (1, 1, 0.5)], ids=["one texture", "another in the last picture"])
def test_pictures_share_what_is_the_same(factors):
    """And no more: each picture's scene comes out as it was given; the sought heights take no room."""
    texels = np.random.default_rng(0).uniform(0.2, 0.9, (4, 5, 3))
    given = [scenes(albedo=jaxhf.ImageTexture(factor * texels))[k] for k, factor in enumerate(factors)]
    problem, _ = posed(given, [np.zeros((SIZE, SIZE))] * 3, given_with(start=0.0))
    (group,) = problem.groups
    alike = len(set(factors)) == 1
    stacked, shared = ([leaf.shape for leaf in jax.tree.leaves(part)] for part in (group.scenes, group.shared))
    assert shared.count((4, 5, 3)) == alike
    assert stacked.count((3, 4, 5, 3)) == (not alike)
    assert TRUTH.shape not in shared
    assert (3, *TRUTH.shape) not in stacked
    for k, scene in enumerate(given):
        found = group.complete(jax.tree.map(lambda leaf, k=k: leaf[k], group.scenes), jnp.asarray(scene.heights))
        assert jax.tree.structure(found) == jax.tree.structure(localise(scene))
        jax.tree.map(np.testing.assert_array_equal, found, localise(scene))


def test_masked_pixels_do_not_count_as_brightness(monkeypatch):
    """Of which the least noise and the first guess are shares: a saturated corner made noise of 500 from values up to 1e6."""
    given, weight = pictures(), np.ones((SIZE, SIZE))
    weight[:9, :9] = 0
    problems = []

    def not_run(all_levels, *_):
        problems.append(all_levels[-1])
        raise StopIteration

    monkeypatch.setattr(_fit, "run", not_run)
    for value in (np.nan, 1e6, np.inf):
        measured = [np.where(weight > 0, picture, value) for picture in given]
        with pytest.raises(StopIteration):
            jaxhf.fit(scenes(), measured, weights=[weight] * 3)
    np.testing.assert_allclose([problem.noise for problem in problems[1:]], [problems[0].noise] * 2)
    assert problems[0].noise.max() < 0.01


def test_the_robust_loss_is_geman_and_mcclures():
    """As the half square of what a solver squares, and its derivatives by `influence_function`."""
    k, r = 2.0, np.array([-30.0, -2.5, -1.3, 1e-5, 0.7, 2.001, 9.0], np.float32)
    x = r.astype(np.float64) / k
    rho, slope, curvature = x**2 / (1 + x**2) / 2, x / (1 + x**2) ** 2, (1 - 3 * x**2) / (1 + x**2) ** 3
    softened = soften(jnp.asarray(r), jnp.asarray(k))
    np.testing.assert_allclose(np.square(softened, dtype=np.float64) / 2, k**2 * rho, rtol=1e-5)
    np.testing.assert_array_equal(np.sign(softened), np.sign(r))
    psi, psi_slope, weight = influence_function(r, jnp.asarray(k))
    np.testing.assert_allclose(psi, k * slope, rtol=1e-5)
    np.testing.assert_allclose(psi_slope, curvature, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(weight * r, psi, rtol=1e-5)
    derived = jax.vmap(jax.grad(lambda r: soften(r, jnp.asarray(k)) ** 2 / 2))(jnp.asarray(r))
    np.testing.assert_allclose(derived, psi, rtol=1e-5)


def test_the_basis_is_the_cosine_transform():
    field = jaxhf.Heightfield(np.zeros((5, 8)), dx=2.0, dy=1.0)
    basis = basis_of(field, np.ones((5, 8)))
    coefficients = np.random.default_rng(0).standard_normal((5, 8))
    expected = 1 + np.asarray(scipy.fft.idctn(np.asarray(basis.scale) * coefficients, norm="ortho"))
    np.testing.assert_allclose(basis.heights(jnp.asarray(coefficients)), expected, rtol=1e-5, atol=1e-5)
    half = basis_of(field, np.ones((5, 8)), 0.5)
    assert np.count_nonzero(half.scale) == 3 * 4 - 1  # not the constant one, before all others are there


def test_balanced_units_give_all_modes_one_curvature():
    """But those along which the loss is flat."""
    curvature = np.array([[1e-4, 4.0], [9.0, 0.0]])
    slopes = np.array([[2.0, 1.0], [1.0, 1.0]])
    units, typical = _balanced_units(slopes, curvature)
    assert typical == 4  # of 4e-4, 4 and 9
    np.testing.assert_allclose((units**2 * curvature).ravel()[:3], typical)
    assert units[1, 1] == 1


def test_resampling_keeps_a_plane():
    y, x = np.mgrid[0:1:4j, 0:1:6j]
    fine_y, fine_x = np.mgrid[0:1:9j, 0:1:5j]
    np.testing.assert_allclose(resample(2 * x - y, (9, 5)), 2 * fine_x - fine_y, atol=1e-12)


def problems_of(*shapes: tuple[int, int]) -> list[Problem]:
    return [posed(scenes(np.zeros(shape)), BLACK, given_with(settings=SETTINGS))[0] for shape in shapes]


def test_stages_double_from_eight_modes():
    """Through the heights of each level, all modes of the finest once more, and in the end by factors."""

    def shares(*shapes: tuple[int, int]) -> list[tuple[int, float]]:
        *stepped, last = stages(problems_of(*shapes))
        assert last == (len(shapes) - 1, 1.0, True)
        assert not any(stage.by_factors for stage in stepped)
        return [stage[:2] for stage in stepped]

    assert shares((64, 40)) == [(0, 0.125), (0, 0.25), (0, 0.5), (0, 1.0), *[(0, 1.0)] * 3]
    assert shares((12, 12)) == [(0, 1.0)] * 4
    assert shares((16, 16), (64, 64)) == [(0, 0.5), (0, 1.0), (1, 0.5), (1, 1.0), *[(1, 1.0)] * 3]


def test_coarser_pictures_are_means_of_the_pixels_that_count():
    """Of 24 x 26 pixels, the longer side of which a coarse pixel overlaps; cameras see the same through as many fewer."""
    rng = np.random.default_rng(0)
    camera = jaxhf.Perspective.look_at((0.5, 0.5, 3), (0.5, 0.5, 0), up=(0, 1, 0), fov=18.6, width=26, height=24)
    picture, weight = rng.uniform(size=(24, 26)), np.ones((24, 26))
    weight[:4, 1:5] = 0.0
    weight[0, 1] = 2.0
    held = np.where(np.indices(TRUTH.shape)[0] == 0, TRUTH + 0.01, np.nan)
    known = given_with(weights=[weight], prior=jaxhf.Prior(TRUTH, 0.1, 0.4, held))
    (scene,), (target,), arguments = coarser([scenes(TRUTH)[0].with_camera(camera)], [picture], known, 4)
    assert (scene.camera.height, scene.camera.width) == target.shape == (6, 7)
    np.testing.assert_allclose(target[2, 3], picture[8:12, 11:15].mean())
    counted = picture[:4, 0].sum(), picture[:4, 1] * weight[:4, 1] ** 2, picture[:4, 2] * 0
    np.testing.assert_allclose(target[0, 0] * (4 + 4), counted[0] + counted[1].sum())
    assert arguments.weights is not None
    np.testing.assert_allclose(arguments.weights[0][2, 3], 4.0)  # sixteen pixels tell as much as one of a fourth of the noise
    np.testing.assert_allclose(arguments.weights[0] ** 2 @ np.ones(7) @ np.ones(6), np.sum(weight**2))
    for x, y in ((0.0, 0.0), (3.5, 2.0), (7.0, 6.0)):
        fine, coarse = camera.ray(jnp.asarray(4 * x - 1), jnp.asarray(4 * y)), scene.camera.ray(jnp.asarray(x), jnp.asarray(y))
        np.testing.assert_allclose(coarse.d, fine.d, atol=1e-6)
    field = scene.heightfields[0]
    assert field.heights.shape == (4, 4)
    np.testing.assert_allclose(field.dx * 3, 1)
    assert arguments.prior is not None
    np.testing.assert_allclose(arguments.prior.heights, field.heights, atol=1e-6)
    assert arguments.prior.length == 0.4
    np.testing.assert_allclose(arguments.prior.held[0], np.interp(np.linspace(0, 11, 4), np.arange(12), held[0]))
    assert np.isnan(arguments.prior.held[1:]).all()


def test_many_samples_ask_for_coarser_levels():
    def asked(side: int, count: int, seam: bool = False) -> list[int]:
        camera = jaxhf.Orthographic.look_at((0.5, 0.5, 3), (0.5, 0.5, 0), up=(0, 1, 0), width=side, height=side)
        field = jaxhf.Heightfield(np.zeros((count, count)), seam=np.zeros((count, count, 2)) if seam else None)
        return factors([jaxhf.Scene([jaxhf.Object(field)], camera)] * 3, 4)

    assert asked(256, 256) == [1]
    assert asked(512, 512) == [4, 1]
    assert asked(2048, 2048) == [16, 4, 1]
    assert asked(2048, 64) == [1]  # heights are few
    assert asked(512, 512, seam=True) == [1]  # coarse heights have none, and would move it


BLACK = [np.zeros((SIZE, SIZE))] * 3


def prior(**changes: Any) -> dict[str, Any]:
    return {"prior": lambda: jaxhf.Prior(**{"heights": 0.0, "std": 1.0, **changes})}


def unknown(**values: Any) -> dict[str, Any]:
    return {"unknown": lambda: jaxhf.Unknown(**values)}


REFUSED: dict[str, list[dict[str, Any]]] = {  # the argument that is to be named, and what is wrong
    "targets": [{"targets": BLACK[:1]}, {"targets": None}],
    "targets[0]": [{"targets": ["a.png"] * 3}, {"targets": [None] * 3}],
    "targets[1]": [{"targets": [BLACK[0], np.zeros((24, 23)), BLACK[0]]}],
    "targets[2]": [{"targets": [*BLACK[:2], np.where(np.arange(SIZE) == 2, np.nan, BLACK[0])]}],
    "weights": [{"weights": [None]}, {"weights": 1.0}],
    "weights[0]": [{"weights": [w, None, None]} for w in (np.ones(3), np.zeros((SIZE, SIZE)), "mask.png")],
    "noise": [*({"noise": noise} for noise in (0, "low", np.ones((24, 24)))), unknown(albedo="map", albedo_length=0.1)],
    "prior": [{"prior": TRUTH}],
    "heights": [prior(heights="map.tif"), prior(heights=lambda: 3), prior(heights=np.array([[0.0, np.nan], [0.0, 0.0]]))],
    "std": [prior(std=std) for std in (np.ones((5, 5)), np.eye(5), -21, 0, "low", np.inf)],
    "length": [prior(length=length) for length in (0, 8.0, "3")],
    "start": [{"start": [[0.0, np.inf], [0.0, 0.0]]}],
    "draws": [{"draws": "some"}, {"draws": 1}, {"draws": -3}],
    "max_steps": [{"max_steps": 0}],
    "unknown": [{"unknown": "albedo"}],
    "albedo": [unknown(albedo="known")],
    "albedo_std": [unknown(albedo_std=2), unknown(albedo="map", albedo_std=0)],
    "albedo_length": [unknown(albedo_length=0.1), unknown(albedo="map", albedo_length=0)],
    "albedo_shared": [unknown(albedo_shared=True), unknown(albedo="map", albedo_shared="yes")],
    "sky_std": [unknown(sky_std=0), unknown(sky_std=1)],
    "light_std": [unknown(light_std=0), unknown(light_std=60), {"scenes": lambda: lamps(), **unknown(light_std=1)}],
    "material_std": [
        *(unknown(material_std=std) for std in ({}, "limb", {"limb": 0})),
        *(unknown(material_std={name: 0.1}) for name in ("limb", "albedo")),  # of Matte
    ],
    "camera_std": [unknown(camera_std=std) for std in (3, (1, 0), (3, 1), (0.1, 60))],
    "exposures": [unknown(exposures="yes")],
    "scenes": [{"scenes": list}],
    "scenes[0]": [{"scenes": lambda: scenes(np.where(np.eye(12) > 0, np.nan, 0.05))}],
    "scenes[1]": [{"scenes": lambda: [scenes()[0], scenes(np.zeros((5, 5)))[1], scenes()[2]]}],
    "settings": [{"settings": {}}],
    "progress": [{"progress": "yes"}],
    "checkpoint": [{"checkpoint": 3}, {"checkpoint": "fit.checkpoint"}],
    "path": [{"checkpoint": lambda: jaxhf.Checkpoint(3)}],  # pyright: ignore
    "mesh": [{"mesh": 2}],
}


def lamps() -> list[jaxhf.Scene]:
    """The second picture has no sun."""
    first, second, third = scenes()
    return [first, second.with_lights([jaxhf.Sky(1.0), jaxhf.Point((0.5, 0.5, 3.0))]), third]


def usual_but(wrong: dict[str, Any]) -> dict[str, Any]:
    """Arguments of `fit`; those that are refused as they are made are made here."""
    usual: dict[str, Any] = {"scenes": scenes, "targets": BLACK}
    return {name: value() if callable(value) else value for name, value in (usual | wrong).items()}


@pytest.mark.parametrize("argument", REFUSED)
def test_bad_input_is_refused_by_name(argument, as_users_call_it):
    for wrong in REFUSED[argument]:
        with pytest.raises(ArgumentError) as refused:
            jaxhf.fit(**usual_but(wrong))
        assert refused.value.argument == argument, refused.value


def test_what_is_wrong_is_told_with_its_place_and_value():
    """One message of each kind: a place in an array, a size, a name for an array."""
    spoilt = [*BLACK[:2], np.where(np.arange(SIZE) == 2, np.nan, BLACK[0])]
    for wrong, message in (
        ({"targets": spoilt}, r"^fit: targets\[2\] must be finite.*row 0 column 2 channel 0 is nan"),
        (unknown(camera_std=(3, 1)), r"^Unknown: camera_std must .* the terrain's longer side, 1; it is 3, or 33 cells"),
        (prior(heights="map.tif"), r"^Prior: heights must be .*, it is a name: jaxhf.load_heights\('map\.tif'\)\.heights"),
    ):
        with pytest.raises(ValueError, match=message):
            jaxhf.fit(**usual_but(wrong))


@pytest.mark.x64
def test_single_heights_in_a_process_with_double_precision_are_refused():
    with pytest.raises(ArgumentError, match="scenes must have float64 heights where JAX's x64 mode is on"):
        jaxhf.fit(scenes(np.zeros((12, 12), np.float32)), BLACK)
