"""What a fit is made of, piece by piece: priors, losses, modes and stages; and what is refused before anything is traced."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
import scipy.fft
import scipy.special
from small_fits import SETTINGS, SIZE, TRUTH, fit_options, pictures, scenes

import jaxhf
from jaxhf.core.errors import ArgumentError
from jaxhf.fitting import fit as _fit, loop as _loop
from jaxhf.fitting.basis import Unknowns, balanced_units, make_basis, resample
from jaxhf.fitting.loop import FitLoop
from jaxhf.fitting.options import make_stages
from jaxhf.fitting.prior import Prior, make_prior
from jaxhf.fitting.problem import Problem, make_problem
from jaxhf.fitting.residuals import _with_albedo, prior_residuals
from jaxhf.fitting.robust import influence_function, soften
from jaxhf.preparation.localise import localise
from jaxhf.xla.devices import local_mesh


def without_pictures(field: jaxhf.Heightfield, **values: Any) -> Problem:
    """The problem of a fit to no pictures."""
    none = np.zeros(0)
    base = np.zeros(field.heights.shape) if "prior" not in values else np.asarray(values["prior"].heights)
    known: dict[str, Any] = {
        "groups": (), "basis": make_basis(field, base), "prior": None, "smoothness": None, "albedo_smoothness": None,
        "loss_scale": None, "noise": none, "brightness": none, "loss": "squares", "settings": SETTINGS, "mesh": local_mesh(),
    }  # fmt: skip
    return Problem(**{**known, **values})


def test_what_is_known_beforehand_counts_in_standard_deviations():
    """The prior at each height, and smoothness as the sum of differences to the neighbours: none on a slope but at its ends."""
    x = np.arange(6.0)[None, :] + np.zeros((5, 1))
    prior = Prior(jnp.asarray(x - 1), jnp.asarray(np.full((5, 6), 1 / 4)))
    field = jaxhf.Heightfield(x)
    smooth = {"smoothness": jnp.asarray(1 / 2), "albedo_smoothness": jnp.asarray(1 / 8)}
    problem = without_pictures(field, prior=prior, basis=make_basis(field, x), **smooth)
    factors = jnp.asarray(np.stack([x * x, x], axis=-1))
    off, rough, rough_paint, _ = prior_residuals(Unknowns(jnp.zeros((5, 6)), factors), problem)
    np.testing.assert_allclose(off, 1 / 4)
    np.testing.assert_allclose(rough, [[1 / 2, 0, 0, 0, 0, -1 / 2]] * 5)
    np.testing.assert_allclose(rough_paint[:, 1:-1], 2 / 8)


def test_errors_of_a_prior_are_correlated_as_whittle_said():
    """Its covariance as a matrix: prior_std at every vertex, and between two of them by the distance in world units."""
    ny, nx, std = 25, 31, np.linspace(1, 3, 25 * 31).reshape(25, 31)
    field = jaxhf.Heightfield(np.zeros((ny, nx)), dx=0.5, dy=1.0)
    prior = make_prior(field, 0.0, std, 3.0, 2.0)
    assert prior is not None
    still, problem = jnp.zeros(prior.heights.shape), without_pictures(field, prior=prior)
    rows = jax.jacfwd(lambda modes: prior_residuals(Unknowns(modes), problem)[0])(still).reshape(still.size, -1)
    heights = jax.jacfwd(problem.basis.heights)(still).reshape(ny * nx, -1)
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
    found = _with_albedo(given, jnp.full((4, 5, 1), 2.0))
    assert eqx.tree_equal(localise(found), localise(expected), typematch=False)


@pytest.mark.parametrize("factors", [(1, 1, 1), (1, 1, 0.5)], ids=["one texture", "another in the last picture"])
def test_pictures_share_what_is_the_same(factors):
    """And no more: each picture's scene comes out as it was given; the sought heights take no room."""
    texels = np.random.default_rng(0).uniform(0.2, 0.9, (4, 5, 3))
    given = [scenes(albedo=jaxhf.ImageTexture(factor * texels))[k] for k, factor in enumerate(factors)]
    problem, _ = make_problem(given, [np.zeros((SIZE, SIZE))] * 3, fit_options(start=0.0))
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
    monkeypatch.setattr(_fit, "FitLoop", lambda problem, *_: problems.append(problem))
    for value in (np.nan, 1e6, np.inf):
        measured = [np.where(weight > 0, picture, value) for picture in given]
        with pytest.raises(AttributeError):  # there is no loop to run
            jaxhf.fit(scenes(), measured, weights=[weight] * 3)
    np.testing.assert_allclose([problem.noise for problem in problems[1:]], [problems[0].noise] * 2)
    assert problems[0].noise.max() < 0.01


# ρ, ρ' and ρ'' of a residual over the scale, x, for the scale 1.
LOSSES = {
    "squares": (lambda x: x**2 / 2, lambda x: x, lambda x: 1 + 0 * x),
    "huber": (
        lambda x: np.where(abs(x) < 1, x**2 / 2, abs(x) - 1 / 2),
        lambda x: np.clip(x, -1, 1),
        lambda x: np.where(abs(x) < 1, 1.0, 0.0),
    ),
    "cauchy": (lambda x: np.log1p(x**2) / 2, lambda x: x / (1 + x**2), lambda x: (1 - x**2) / (1 + x**2) ** 2),
    "geman": (lambda x: x**2 / (1 + x**2) / 2, lambda x: x / (1 + x**2) ** 2, lambda x: (1 - 3 * x**2) / (1 + x**2) ** 3),
}


@pytest.mark.parametrize("loss", LOSSES)
def test_robust_losses_are_those_of_the_literature(loss):
    """As the half square of what a solver squares, and its derivatives by `influence_function`."""
    k, r = 2.0, np.array([-30.0, -2.5, -1.3, 1e-5, 0.7, 2.001, 9.0], np.float32)
    rho, slope, curvature = (f(r.astype(np.float64) / k) for f in LOSSES[loss])
    softened = soften(jnp.asarray(r), loss, jnp.asarray(k))
    np.testing.assert_allclose(np.square(softened, dtype=np.float64) / 2, k**2 * rho, rtol=1e-5)
    np.testing.assert_array_equal(np.sign(softened), np.sign(r))
    psi, psi_slope, weight = influence_function(r, loss, jnp.asarray(k))
    np.testing.assert_allclose(psi, k * slope, rtol=1e-5)
    np.testing.assert_allclose(psi_slope, curvature, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(weight * r, psi, rtol=1e-5)
    derived = jax.vmap(jax.grad(lambda r: soften(r, loss, jnp.asarray(k)) ** 2 / 2))(jnp.asarray(r))
    np.testing.assert_allclose(derived, psi, rtol=1e-5)


def test_the_basis_is_the_cosine_transform():
    field = jaxhf.Heightfield(np.zeros((5, 8)), dx=2.0, dy=1.0)
    basis = make_basis(field, np.ones((5, 8)))
    coefficients = np.random.default_rng(0).standard_normal((5, 8))
    expected = 1 + np.asarray(scipy.fft.idctn(np.asarray(basis.scale) * coefficients, norm="ortho"))
    np.testing.assert_allclose(basis.heights(jnp.asarray(coefficients)), expected, rtol=1e-5, atol=1e-5)
    half = make_basis(field, np.ones((5, 8)), 0.5)
    assert np.count_nonzero(half.scale) == 3 * 4 - 1  # not the constant one, before all others are there


def test_balanced_units_give_all_modes_one_curvature():
    """But those along which the loss is flat; and the mean alone, where a solver's steps are in units of one slope."""
    curvature = np.array([[1e-4, 4.0], [9.0, 0.0]])
    slopes = np.array([[2.0, 1.0], [1.0, 1.0]])
    units, typical = balanced_units(slopes, curvature)
    assert typical == 4  # of 4e-4, 4 and 9
    np.testing.assert_allclose((units**2 * curvature).ravel()[:3], typical)
    assert units[1, 1] == 1
    np.testing.assert_allclose(balanced_units(slopes, curvature, mean_only=True)[0], [[200.0, 1], [1, 1]])


def test_resampling_keeps_a_plane():
    y, x = np.mgrid[0:1:4j, 0:1:6j]
    fine_y, fine_x = np.mgrid[0:1:9j, 0:1:5j]
    np.testing.assert_allclose(resample(2 * x - y, (9, 5)), 2 * fine_x - fine_y, atol=1e-12)


@pytest.mark.parametrize(("spread", "scale", "goes_on"), [(2.0, 6.0, True), (1.05, 3.0, False), (0.5, 3.0, False)])
def test_a_robust_loss_at_its_final_scale_needs_no_other_stage(monkeypatch, spread, scale, goes_on):
    monkeypatch.setattr(_loop, "pictures_and_influence", lambda *_: ([], np.zeros((5, 6))))
    monkeypatch.setattr(_loop, "spreads_of", lambda pictures, problem: np.array([spread]))
    monkeypatch.setattr(FitLoop, "known", lambda loop, unknowns: loop.problem)
    field, one = jaxhf.Heightfield(np.zeros((5, 6))), np.ones(1)
    problem = without_pictures(field, loss_scale=jnp.asarray(3.0), noise=one, brightness=one, loss="geman")
    options = fit_options(noise=1.0, levels=[0.5, 1.0], settings=SETTINGS)
    loop = FitLoop(problem, Unknowns(jnp.zeros((5, 6))), field, options)
    loop.initial_state = None
    loop._next_stage()
    assert loop.stage == 0
    assert loop._next_stage()  # there are still modes to come
    assert loop.stage == 1
    assert loop.problem.loss_scale == scale
    monkeypatch.setattr(_loop, "spreads_of", lambda pictures, problem: np.array([1.0]))
    assert loop._next_stage() == goes_on
    assert loop.problem.loss_scale == 3


def test_levels_double_from_eight_modes():
    assert make_stages((64, 40), fit_options(loss="squares", noise=1.0)) == [0.125, 0.25, 0.5, 1.0]
    assert make_stages((12, 12), fit_options(loss="huber")) == [1.0, 1.0, 1.0, 1.0]
    assert make_stages((64, 64), fit_options(solver="adam", loss="squares", noise=1.0)) == [1.0]
    assert make_stages((12, 12), fit_options(loss="squares")) == [1.0, 1.0, 1.0, 1.0]  # the noise has to settle


BLACK = [np.zeros((SIZE, SIZE))] * 3
WITH_PRIOR = {"prior": 0.0, "prior_std": 1.0}
REFUSED: dict[str, list[dict[str, Any]]] = {  # the argument that is to be named, and what is wrong
    "targets": [{"targets": BLACK[:1]}, {"targets": None}],
    "targets[0]": [{"targets": ["a.png"] * 3}, {"targets": [None] * 3}],
    "targets[1]": [{"targets": [BLACK[0], np.zeros((24, 23)), BLACK[0]]}],
    "targets[2]": [{"targets": [*BLACK[:2], np.where(np.arange(SIZE) == 2, np.nan, BLACK[0])]}],
    "weights": [{"weights": [None]}, {"weights": 1.0}],
    "weights[0]": [{"weights": [w, None, None]} for w in (np.ones(3), np.zeros((SIZE, SIZE)), "mask.png")],
    "noise": [{"noise": noise} for noise in (0, "low", np.ones((24, 24)))],
    "prior": [{"prior": 0.0}, {"prior": "map.tif"}, {"prior": jaxhf.jacksboro(), "prior_std": 1.0}],
    "prior_std": [{"prior_std": 1.0}, *({**WITH_PRIOR, "prior_std": std} for std in (np.ones((5, 5)), -21, np.eye(12)))],
    "prior_length": [{"prior_length": 1.0}, *({**WITH_PRIOR, "prior_length": length} for length in (0, 8.0, "3"))],
    "prior_exponent": [{**WITH_PRIOR, "prior_exponent": 3}, {"prior_length": 0.3, "prior_exponent": 99}],
    "start": [{"start": [[0.0, np.inf], [0.0, 0.0]]}],
    "solver": [{"solver": "sgd"}],
    "levels": [{"levels": [0.5]}, {"levels": 3}],
    "resume": [{"resume": True}],
    "uncertainty": [{"uncertainty": "some"}, {"scenes": lambda: scenes(np.zeros((65, 65))), "uncertainty": "exact"}],
    "max_steps": [{"max_steps": 0}],
    "smoothness": [{"smoothness": -1}],
    "albedo_smoothness": [{"albedo_smoothness": 1.0}],
    "light_std": [{"light_std": 0}, {"light_std": 60}, {"scenes": lambda: lamps(), "light_std": 1}],
    "camera_std": [{"camera_std": std} for std in (3, (1, 0), (3, 1), (0.1, 60))],
    "loss_scale": [{"loss": "squares", "loss_scale": 5}, {"loss_scale": None}],
    "scenes": [{"scenes": list}],
    "scenes[0]": [{"scenes": lambda: scenes(np.where(np.eye(12) > 0, np.nan, 0.05))}],
    "scenes[1]": [{"scenes": lambda: [scenes()[0], scenes(np.zeros((5, 5)))[1], scenes()[2]]}],
    "settings": [{"settings": {}}],
    "exposures": [{"exposures": "yes"}],
    "progress": [{"progress": "yes"}],
    "checkpoint": [{"checkpoint": 3}],
    "mesh": [{"mesh": 2}],
}


def lamps() -> list[jaxhf.Scene]:
    """The second picture has no sun."""
    first, second, third = scenes()
    return [first, second.with_lights([jaxhf.Sky(1.0), jaxhf.Point((0.5, 0.5, 3.0))]), third]


@pytest.fixture
def as_users_call_it():
    """Where nothing checks annotations first."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.mark.parametrize("argument", REFUSED)
def test_bad_input_is_refused_by_name(argument, as_users_call_it):
    for wrong in REFUSED[argument]:
        options = {"targets": BLACK, **wrong, "scenes": wrong.get("scenes", scenes)()}
        with pytest.raises(ArgumentError) as refused:
            jaxhf.fit(**options)
        assert refused.value.argument == argument, refused.value


def test_what_is_wrong_is_told_with_its_place_and_value():
    """One message of each kind: a place in an array, a size, a name for an array."""
    spoilt = [*BLACK[:2], np.where(np.arange(SIZE) == 2, np.nan, BLACK[0])]
    for wrong, message in (
        ({"targets": spoilt}, r"^fit: targets\[2\] must be finite.*row 0 column 2 channel 0 is nan"),
        ({"camera_std": (3, 1)}, r"^fit: camera_std must .* the terrain's longer side, 1; it is 3, or 33 cells"),
        ({"prior": "map.tif"}, r"it is a name: jaxhf.load_heights\('map\.tif'\)\.heights"),
    ):
        with pytest.raises(ValueError, match=message):
            jaxhf.fit(scenes(), **{"targets": BLACK, **wrong})


@pytest.mark.x64
def test_single_heights_in_a_process_with_double_precision_are_refused():
    with pytest.raises(ArgumentError, match="scenes must have float64 heights where JAX's x64 mode is on"):
        jaxhf.fit(scenes(np.zeros((12, 12), np.float32)), BLACK)
