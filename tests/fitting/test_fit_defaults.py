"""What a fit chooses by itself, and what it says of its result."""

import dataclasses
import inspect

import jax.numpy as jnp
import numpy as np
import pytest
from test_fit import OPTIONS, SETTINGS, TRUTH, fit_options, pictures, rms, scenes

import jaxhf
from jaxhf.fitting import defaults as _defaults, uncertainty as _uncertainty
from jaxhf.fitting.defaults import choose_edge_samples, choose_samples
from jaxhf.fitting.diagnosis import Findings, Places, warnings, where_residuals_are, worst_regions
from jaxhf.fitting.history import Draws
from jaxhf.fitting.jacobian import in_rows
from jaxhf.fitting.known import spreads_of
from jaxhf.fitting.normal_matrix import NormalMatrix
from jaxhf.fitting.normals import evidence_for_angles, share_of_normals
from jaxhf.fitting.problem import make_problem
from jaxhf.fitting.residuals import linearised, picture_residuals
from jaxhf.fitting.robust import influence_function, soften
from jaxhf.fitting.uncertainty import with_unexplained
from jaxhf.scene.localise import localise

pytestmark = pytest.mark.unoptimised


def test_noise_that_is_not_given_is_estimated():
    """To a tenth, of each picture its own, in spite of a robust loss and of pixels that are far off."""
    rng, truth = np.random.default_rng(3), np.array([0.01, 0.02, 0.01])
    measured = [picture + noise * rng.standard_normal(picture.shape) for picture, noise in zip(pictures(), truth, strict=True)]
    measured[0][:2] += 0.5
    found = jaxhf.fit(scenes(), measured, settings=SETTINGS)
    np.testing.assert_allclose(found.noise, truth, rtol=0.12)
    assert rms(np.asarray(found.heights) - np.mean(found.heights) - TRUTH + TRUTH.mean()) < 0.1 * np.ptp(TRUTH)
    assert found.stats["chi2"] > 10
    assert found.regions[0].picture == 0
    assert found.regions[0].row == 0
    assert any("chi2 is" in warning and "picture 0 rows 0-3" in warning for warning in found.warnings)


def test_the_noise_of_rounded_pictures_is_their_root_mean_square():
    """Rounding leaves errors that are evenly spread: their median would be a quarter too large for a deviation."""
    step = 0.05
    problem, _ = make_problem(scenes(), [step * np.round(picture / step) for picture in pictures()], fit_options())
    exact = [
        jnp.stack([jnp.asarray(pictures()[k]).reshape(group.targets.shape[1:]) for k in group.indices])
        for group in problem.groups
    ]
    np.testing.assert_allclose(spreads_of(exact, problem), step / np.sqrt(12), rtol=0.1)


def test_normals_of_another_renderer_are_named_where_they_matter():
    """By how much they turn: hardly any on the smooth terrain, by 20 degrees on steps of a cell's width."""
    steps = np.where(np.indices((12, 12)).sum(0) % 3 == 0, 1 / 11, 0.0)
    found = [
        share_of_normals(
            make_problem(scenes(), pictures(), fit_options(settings=settings, noise=0.02))[0], jnp.asarray(heights)
        )
        for settings, heights in ((SETTINGS, TRUTH), (SETTINGS, steps), (jaxhf.Settings(normals="six-angle"), steps))
    ]
    assert found[0] < 0.5 < 2 < found[1]
    assert found[2] == 0


def test_a_fit_takes_the_normals_that_explain_rough_terrain():
    """Where they are left open; those that are given stay, and the others are named."""
    rng = np.random.default_rng(2)
    rough = TRUTH + 0.02 * rng.standard_normal(TRUTH.shape)
    angle = dataclasses.replace(SETTINGS, normals="six-angle")
    measured = [np.asarray(jaxhf.render(scene, angle))[..., 0] for scene in scenes(rough)]
    measured = [picture + 0.002 * rng.standard_normal(picture.shape) for picture in measured]
    known = {"noise": 0.002, "levels": [1.0], "prior": TRUTH, "prior_std": 0.02}
    chosen = jaxhf.fit(scenes(TRUTH), measured, settings=SETTINGS, **known)
    assert chosen.settings.normals == "six-angle"
    assert any("Settings(normals='six-angle') says" in warning for warning in chosen.warnings)
    given = jaxhf.fit(scenes(TRUTH), measured, settings=dataclasses.replace(SETTINGS, normals="six"), **known)
    assert given.settings.normals == "six"
    assert rms(chosen.heights - rough) < 0.5 * rms(given.heights - rough)


def test_evidence_for_other_normals_is_in_the_pictures():
    """Many deviations where they are by angle, none where they are by area."""
    rng = np.random.default_rng(2)
    rough = TRUTH + 0.02 * rng.standard_normal(TRUTH.shape)
    found = {}
    for scheme in ("six", "six-angle"):
        rendered = [
            np.asarray(jaxhf.render(scene, dataclasses.replace(SETTINGS, normals=scheme)))[..., 0] for scene in scenes(rough)
        ]
        measured = [picture + 0.002 * rng.standard_normal(picture.shape) for picture in rendered]
        problem, unknowns = make_problem(scenes(rough), measured, fit_options(noise=0.002, start=rough))
        known = linearised(unknowns, problem)
        left = in_rows(picture_residuals(unknowns, known))
        found[scheme] = evidence_for_angles(known, jnp.asarray(rough), left)
    assert found["six"] < 3
    assert found["six-angle"] > 20


def test_a_grey_picture_with_three_channels_is_one_measurement():
    grey = pictures()
    colour = np.stack([grey[0], 0.5 * grey[0], grey[0]], axis=-1)
    holed = np.where(np.arange(24)[:, None, None] > 2, np.stack(3 * [grey[2]], axis=-1), [0.1, 0.2, np.nan])
    weights = [None, None, np.repeat((np.arange(24) > 2)[:, None], 24, axis=1)]
    problem, _ = make_problem(scenes(), [colour, np.stack(3 * [grey[1]], axis=-1), holed], fit_options(weights=weights))
    channels = {k: group.targets.shape[-1] for group in problem.groups for k in group.indices}
    assert channels == {0: 3, 1: 1, 2: 1}


def test_edges_take_part_where_boundaries_are_in_sight():
    """From above and inside the border there are none; a border, a ridge in low light, or a silhouette ask for some."""
    flat, beside = scenes()[0], jaxhf.Perspective.look_at((0.5, -1, 1), (0.5, 0.5, 0), fov=60.0, width=24, height=24)
    ridge = flat.with_heights(np.where(np.arange(12) == 6, 0.3, 0.0) * np.ones((12, 1)))
    low = ridge.with_lights([jaxhf.Directional((1, 0, 0.2))])
    counts = [
        choose_edge_samples([localise(scene)], jaxhf.Settings(samples=1, shadows=shadows))
        for scene, shadows in ((flat, True), (flat.with_camera(beside), False), (low, True), (low, False))
    ]
    assert counts == [0, 2048, 2048, 0]
    assert choose_samples([flat], jaxhf.Settings()).samples == 4
    assert choose_samples([dataclasses.replace(flat, samples=16)], jaxhf.Settings()).samples == 16
    assert choose_samples([flat], jaxhf.Settings(samples=1)).samples == 1


def test_the_length_of_boundaries_is_one_program(monkeypatch):
    """Whether edges are to be chosen for the first time, or once more beside those of the start."""
    asked = []
    monkeypatch.setattr(_defaults, "_boundary_length", lambda _, settings: asked.append(settings) or 0.0)
    for edge_samples in (None, 2048):
        choose_edge_samples([localise(scenes()[0])], jaxhf.Settings(samples=4, edge_samples=edge_samples))
    assert asked[0] == asked[1]


def test_edges_take_part_where_the_measured_pictures_show_shadows():
    """Though the start throws none; a black background with a sky says nothing."""
    dark = [picture.copy() for picture in pictures()]
    dark[1][:3, :3] = 0.0
    lit, shown, sky = (
        make_problem(given, measured, fit_options())[0].settings.edge_samples
        for given, measured in (
            (scenes(), pictures()), (scenes(), dark),
            ([scene.with_lights([*scene.lights, jaxhf.Sky(0.1)]) for scene in scenes()], dark),
        )
    )  # fmt: skip
    assert (lit, shown, sky) == (0, 2048, 0)


def test_the_users_choice_is_kept():
    problem, _ = make_problem(scenes(), pictures(), fit_options(settings=jaxhf.Settings(samples=9, edge_samples=77)))
    assert (problem.settings.samples, problem.settings.edge_samples) == (9, 77)
    assert inspect.signature(jaxhf.fit).parameters["loss"].default == "geman"


@pytest.mark.parametrize("loss", ["squares", "huber", "cauchy", "geman"])
def test_the_influence_function_is_the_loss_derived(loss):
    r, scale = np.array([-30.0, -2.5, -1.3, 0.1, 0.7, 2.2, 9.0]), jnp.asarray(2.0)

    def rho(r):
        return np.asarray(soften(jnp.asarray(r), loss, scale)) ** 2 / 2

    psi, slope, weight = influence_function(r, loss, scale)
    np.testing.assert_allclose((rho(r + 1e-5) - rho(r - 1e-5)) / 2e-5, psi, rtol=1e-6)
    ahead, behind = (influence_function(r + step, loss, scale)[0] for step in (1e-6, -1e-6))
    np.testing.assert_allclose((ahead - behind) / 2e-6, slope, atol=1e-6)
    np.testing.assert_allclose(weight * r, psi)


def test_what_is_left_unexplained_counts_as_noise():
    """With squares the factor is Birge's ratio: residuals of three times the noise make deviations three times as large."""
    rng = np.random.default_rng(0)
    measured = [picture + 0.03 * rng.standard_normal(picture.shape) for picture in pictures()]
    problem, unknowns = make_problem(scenes(TRUTH), measured, fit_options(**OPTIONS))
    residuals = np.ravel(picture_residuals(unknowns, problem)[0])
    scaled, factor = with_unexplained(problem, residuals)
    assert factor == pytest.approx(3 / np.sqrt(1 - 144 / (3 * 24 * 24)), rel=0.05)
    np.testing.assert_allclose(scaled.groups[0].weights, problem.groups[0].weights / factor)
    assert with_unexplained(problem.with_noise(10 * problem.noise), residuals / 10)[1] == 1


def test_samples_can_be_stopped_with_what_is_there(monkeypatch):
    """After two; before, nothing is known."""
    problem, unknowns = make_problem(scenes(TRUTH), pictures(), fit_options(**OPTIONS))
    reports: list[Draws] = []

    def draw(*_):
        if len(reports) == stop:
            raise KeyboardInterrupt
        return np.full((12, 12), 2.0), np.zeros(0)

    monkeypatch.setattr(NormalMatrix, "draw", draw)
    stop = 3
    std, drawn, *_ = _uncertainty.standard_deviations(unknowns, problem, 20, 60, reports.append)
    assert drawn == 3
    np.testing.assert_array_equal(std, 2.0)
    assert [(report.drawn, report.wanted) for report in reports] == [(1, 20), (2, 20), (3, 20)]
    stop = 1
    reports.clear()
    with pytest.raises(KeyboardInterrupt):
        _uncertainty.standard_deviations(unknowns, problem, 20, 60, reports.append)


def test_the_worst_regions_are_named():
    residual = np.full((64, 32, 1), 0.1)
    residual[8:12, 4:8] = 5.0
    other = np.zeros((64, 32, 1))
    other[60:, 28:] = 3.0
    first, second, third = worst_regions([residual, other])
    assert [first[:5], second[:5]] == [(0, 8, 4, 4, 4), (1, 60, 28, 4, 4)]
    np.testing.assert_allclose([first.rms, second.rms, third.rms], [5.0, 3.0, 0.1])
    assert str(first) == "picture 0 rows 8-11 columns 4-7 (5 times the noise)"


def test_it_says_where_residuals_are():
    residual = np.zeros((8, 8, 1))
    residual[1, 1], residual[5, 5], residual[1, 6] = 3.0, 4.0, 5.0
    silhouettes, shadows = np.zeros((2, 8, 8), bool)
    silhouettes[2, 2] = shadows[5, 4] = True
    said = where_residuals_are([residual], [Places(silhouettes, shadows)])
    assert said.startswith("18% of their squares lie at the terrain's border and silhouettes, 32% at the edges of shadows, 50%")
    assert where_residuals_are([residual], [Places(silhouettes, None)]).startswith("18% of their squares lie beside")


GOOD = Findings(
    result=jaxhf.Stop.CONVERGED, chi2=1.0, noise_given=True, where="", regions=(), help="try this", strayed=0.9,
    seen=np.ones((4, 5), bool), lights=3, scaled=1.0, displaced=(0.5, 1.01), draws=(20, 20), normals=None,
)  # fmt: skip


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"chi2": 4.3}, "differ from the measured ones by 2.1 times the noise"),
        ({"chi2": 4.3}, "came no nearer: try this"),
        ({"chi2": 4.3, "result": jaxhf.Stop.STALLED}, "it stalled: try this"),
        ({"chi2": 0.25}, "the noise that was given is 2 times what is left"),
        ({"result": jaxhf.Stop.MAX_STEPS}, "stopped by max_steps"),
        ({"strayed": 2.5}, "2.5 times prior_std"),
        ({"seen": np.arange(20).reshape(4, 5) > 4}, "no picture shows 5 of 20 heights (25%): they are what the prior makes"),
        ({"seen": np.zeros((4, 5), bool), "strayed": None}, "they are the start"),
        ({"strayed": None, "lights": 1}, "same light and there is no prior"),
        ({"scaled": 1.8}, "1.8 times the noise"),
        ({"displaced": (0.5, 1.2)}, "were off by 0.5, and are 1.2 times as large for it"),
        ({"draws": (20, 7)}, "interrupted after 7 of 20"),
        ({"normals": "six-angle"}, "weighted as Settings(normals='six-angle') says"),
    ],
)
def test_warnings_say_what_speaks_against_the_heights(change, said):
    assert warnings(GOOD) == ()
    assert any(said in warning for warning in warnings(GOOD._replace(**change)))


def test_a_small_chi2_is_no_warning_where_the_noise_was_estimated():
    assert warnings(GOOD._replace(chi2=0.25, noise_given=False)) == ()
