"""What a fit chooses by itself, and what it says of its result."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from small_fits import CAMERA, SETTINGS, TRUTH, expanded, given, off_in_shape, pictures, posed, scenes

import jaxhf
from jaxhf.fitting.given import Draws
from jaxhf.fitting.model.normal_matrix import NormalMatrix, in_row
from jaxhf.fitting.model.pictures import choose_edge_samples, choose_samples
from jaxhf.fitting.solve.noise import spreads
from jaxhf.fitting.trust.facts import (
    Left,
    _share_of_normals,
    dependent_channels,
    have_same_light,
    have_same_view,
    neighbour_correlation,
    shows_mean,
    unlike_noise,
    what_may_help,
)
from jaxhf.fitting.trust.judge import standard_deviations, with_unexplained
from jaxhf.fitting.trust.words import Findings, warnings, where_residuals_are, worst_regions
from jaxhf.preparation.localise import localise

STEPS = np.where(np.indices((12, 12)).sum(0) % 3 == 0, 1 / 11, 0.0)


def test_noise_that_is_not_given_is_estimated():
    """To a tenth, of each picture its own, in spite of a robust loss and of pixels that are far off."""
    rng, truth = np.random.default_rng(3), np.array([0.01, 0.02, 0.01])
    measured = [picture + noise * rng.standard_normal(picture.shape) for picture, noise in zip(pictures(), truth, strict=True)]
    measured[0][:2] += 0.5
    found = jaxhf.fit(scenes(), measured, settings=SETTINGS)
    np.testing.assert_allclose(found.noise, truth, rtol=0.12)
    assert off_in_shape(found.heights) < 0.1
    assert found.stats["chi2"] > 10
    assert found.regions[0].picture == 0
    assert found.regions[0].row == 0
    assert any("chi2 is" in warning and "picture 0 rows 0-3" in warning for warning in found.warnings)
    assert not any("is no noise" in warning for warning in found.warnings)


def test_the_noise_of_rounded_pictures_is_their_root_mean_square():
    """Rounding leaves errors that are evenly spread: their median would be a quarter too large for a deviation."""
    step = 0.05
    here = expanded(scenes(TRUTH), [step * np.round(picture / step) for picture in pictures()], settings=SETTINGS)
    np.testing.assert_allclose(spreads(here), step / np.sqrt(12), rtol=0.1)


def test_normals_of_another_renderer_are_named_where_they_matter():
    """By how much they turn: hardly any on the smooth terrain, by 20 degrees on steps of a cell's width."""
    smooth, steps = (expanded(scenes(heights), pictures(), settings=SETTINGS, noise=0.02) for heights in (TRUTH, STEPS))
    assert _share_of_normals(smooth) < 0.5 < 2 < _share_of_normals(steps)
    other = dataclasses.replace(steps.problem, settings=dataclasses.replace(SETTINGS, normals="six-angle"))
    assert _share_of_normals(steps.of(other)) == 0


def test_a_grey_picture_with_three_channels_is_one_measurement():
    grey = pictures()
    colour = np.stack([grey[0], 0.5 * grey[0], grey[0]], axis=-1)
    holed = np.where(np.arange(24)[:, None, None] > 2, np.stack(3 * [grey[2]], axis=-1), [0.1, 0.2, np.nan])
    weights = [None, None, np.repeat((np.arange(24) > 2)[:, None], 24, axis=1)]
    problem, _ = posed(scenes(), [colour, np.stack(3 * [grey[1]], axis=-1), holed], given(weights=weights))
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


def test_the_length_of_boundaries_is_one_program(programs):
    """At the start and later, of terrains and pictures of any size."""
    for side, edge_samples in ((12, None), (12, 2048), (15, None)):
        camera = dataclasses.replace(scenes()[0].camera, width=side)
        scene = jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(np.zeros((side, side), np.float32)))], camera, [jaxhf.Sky(0.3)])
        choose_edge_samples([localise(scene)], jaxhf.Settings(samples=4, edge_samples=edge_samples))
    assert [name for name, _ in programs].count("boundary_length") == 1


@pytest.mark.parametrize("side", [24, 100])
def test_a_border_that_stands_at_the_pictures_own_is_no_boundary(side):
    """Where a terrain fills its picture rounding says now and then that some of the border is within."""
    field, half = jaxhf.Heightfield(np.zeros((side, side), np.float32), dx=1.0), (side - 1) / 2

    def points(extent: float) -> int:
        eye, target = (half, half, 50.0), (half, half, 0.0)
        camera = jaxhf.Orthographic.look_at(eye, target, up=(0, 1, 0), extent=extent, width=side, height=side)
        return choose_edge_samples([localise(jaxhf.Scene([jaxhf.Object(field)], camera, [jaxhf.Sky(1.0)]))], jaxhf.Settings())

    assert points(side - 1.0) == 0 < points(side - 0.9)


def test_edges_take_part_where_the_measured_pictures_show_shadows():
    """Though the start throws none; a black background with a sky says nothing."""
    dark = [picture.copy() for picture in pictures()]
    dark[1][:3, :3] = 0.0
    lit, shown, sky = (
        posed(views, measured, given())[0].settings.edge_samples
        for views, measured in (
            (scenes(), pictures()), (scenes(), dark),
            ([scene.with_lights([*scene.lights, jaxhf.Sky(0.1)]) for scene in scenes()], dark),
        )
    )  # fmt: skip
    assert (lit, shown, sky) == (0, 2048, 0)


def test_the_users_choice_is_kept():
    problem, _ = posed(scenes(), pictures(), given(settings=jaxhf.Settings(samples=9, edge_samples=77)))
    assert (problem.settings.samples, problem.settings.edge_samples) == (9, 77)


def test_what_is_left_unexplained_counts_as_noise():
    """Residuals of three times the noise make deviations three times as large, or a little less where some are let go."""
    rng = np.random.default_rng(0)
    measured = [picture + 0.03 * rng.standard_normal(picture.shape) for picture in pictures()]
    here = expanded(scenes(TRUTH), measured, settings=SETTINGS, noise=0.01)
    here = here.of(dataclasses.replace(here.problem, loss_scale=jnp.asarray(1e3)))  # squares: it is Birge's ratio
    residuals = in_row(here.left())
    scaled, factor = with_unexplained(here, residuals)
    assert factor == pytest.approx(3 / np.sqrt(1 - 144 / (3 * 24 * 24)), rel=0.05)
    new, old = (each.problem.groups[0].weights for each in (scaled, here))
    np.testing.assert_allclose(new, old / factor, rtol=1e-6)
    assert float(scaled.problem.loss_scale) == pytest.approx(1e3 / factor)
    assert with_unexplained(here, residuals / 10)[1] == 1


def test_draws_can_be_stopped_with_what_is_there(monkeypatch):
    """After two; before, nothing is known."""
    here = expanded(scenes(TRUTH), pictures(), settings=SETTINGS, noise=0.01)
    reports: list[Draws] = []
    solved = NormalMatrix.solved

    def interrupted(*arguments):
        if len(reports) == stop:
            raise KeyboardInterrupt
        return solved(*arguments)

    monkeypatch.setattr(NormalMatrix, "solved", interrupted)
    stop = 3
    found = standard_deviations(here, 20, reports.append)
    assert found.samples.shape == (3, 12, 12)
    np.testing.assert_allclose(found.std, np.sqrt(np.mean(found.samples**2, axis=0)))
    mean, shape = found.parts
    np.testing.assert_allclose(mean**2 + shape**2, np.mean(found.std**2))
    assert [(report.drawn, report.wanted) for report in reports] == [(1, 20), (2, 20), (3, 20)]
    stop = 1
    reports.clear()
    with pytest.raises(KeyboardInterrupt):
        standard_deviations(here, 20, reports.append)


def test_a_noise_that_is_given_too_small_is_told_from_what_the_scene_lacks():
    here = expanded(scenes(TRUTH), pictures(), settings=SETTINGS, noise=0.01)
    noise = np.random.default_rng(0).standard_normal((24, 24, 1))
    known = given(noise=0.01)
    assert "leave noise out" in what_may_help(here, [left(10 * noise)] * 3, known)
    noise[:5] = 30.0
    assert "leave noise out" not in what_may_help(here, [left(noise)] * 3, known)
    assert "leave noise out" not in what_may_help(here, [left(10 * noise)] * 3, given())


def test_other_normals_are_advised_where_they_matter():
    settings = dataclasses.replace(SETTINGS, shadows=True, edge_samples=None)
    for heights, advised in ((STEPS, True), (TRUTH, False)):
        here = expanded(scenes(heights), pictures(), settings=SETTINGS, noise=0.02)
        here = here.of(dataclasses.replace(here.problem, settings=settings))
        said = what_may_help(here, [left(np.zeros((24, 24, 1)))], given(settings=settings, noise=0.02))
        assert ("six-angle" in said) == advised


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
    said = where_residuals_are([residual], [(silhouettes, shadows)])
    assert said.startswith("18% of their squares lie at the terrain's border and silhouettes, 32% at the edges of shadows, 50%")
    assert where_residuals_are([residual], [(silhouettes, None)]).startswith("18% of their squares lie beside")


def left(residual: np.ndarray, **values) -> Left:
    """What a fit leaves of a picture of 0.5, in units of a noise of 0.05."""
    image = np.full(residual.shape, 0.5)
    changes = {"image": image, "target": image - 0.05 * residual, "informing": np.ones(image.shape, bool), **values}
    return Left(residual=residual, noise=0.05, brightness=0.5, **changes)


def test_what_is_left_of_pictures_is_noise_or_is_not():
    """Neighbours of noise have nothing in common, whatever its size and however far off some pixels are."""
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((24, 24, 1))
    noise[5:9, 5:9] = 500.0
    smooth = 3 * np.sin(np.linspace(0, 9, 24))[:, None, None] + noise
    correlation, spread = neighbour_correlation(noise, np.ones(noise.shape, bool))
    assert abs(correlation) < 0.1
    np.testing.assert_allclose(spread, 1, rtol=0.1)
    for multiple in (0.1, 1, 10):
        assert unlike_noise([left(multiple * noise)], given()) is None
    said = unlike_noise([left(noise), left(smooth)], given(prior=jaxhf.Prior(0.0, 1.0)))
    assert said is not None
    assert said.startswith("what is left of picture 1 is no noise: neighbouring pixels are off alike (correlation 0.")
    assert "the prior's std may be too small" in said
    assert unlike_noise([left(smooth)._replace(noise=1e-3)], given()) is None  # as rounding is
    assert unlike_noise([left(smooth, informing=np.zeros((24, 24, 1), bool))], given()) is None


def test_a_picture_of_another_brightness_is_said_to_be_one():
    """Such as one of values up to 255, or of an albedo that is off: its noise is estimated to be as large, and chi2 is 1."""
    image = np.linspace(0.2, 0.5, 576).reshape(24, 24, 1)

    def said(target: np.ndarray, **unknown) -> str:
        known = given(unknown=jaxhf.Unknown(**unknown))
        return str(unlike_noise([left((image - target) / 0.05, image=image, target=target)], known))

    assert "it is 1.5 times as bright as the scene: Unknown(exposures=True)" in said(1.5 * image)
    assert "exposures=True" not in said(1.5 * image, exposures=True)
    assert "it is brighter than the scene by 0.1: Unknown(offsets=True)" in said(image + 0.1)
    assert "offsets=True" not in said(image + 0.1, offsets=True)
    assert "light_std=, camera_std=" in said(1.05 * image)
    assert "light_std=, camera_std=" in said(image[::-1])


def test_channels_that_are_off_alike_are_said_to_be_one_measurement():
    """Of a grey picture that was tinted or compressed: with a thirtieth of the noise of its own each channel counted fully."""
    rng = np.random.default_rng(0)
    grey, own = rng.standard_normal((24, 24, 1)), rng.standard_normal((24, 24, 3))
    assert "picture 1 are off alike (correlation 1.00)" in str(dependent_channels([left(grey), left(grey + own / 30)]))
    assert dependent_channels([left(own)]) is None
    assert dependent_channels([left(0.3 * grey + own / 30)]) is None  # as noise-free pictures are


GOOD = Findings(
    result=jaxhf.Stop.CONVERGED, chi2=1.0, noise_given=True, where="", regions=(), unlike_noise=None, channels=None,
    help="try this", strayed=0.9, seen=np.ones((4, 5), bool), mean_shown=True, noise_share=0.01, same_light=False,
    same_view=True, scaled=1.0, displaced=(0.5, 1.01), draws=(20, 20), parts=(0.1, 0.2), unsure_noise=None, length=None,
)  # fmt: skip


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"chi2": 4.3}, "differ from the measured ones by 2.1 times the noise"),
        ({"chi2": 4.3}, "came no nearer: try this"),
        ({"chi2": 4.3, "result": jaxhf.Stop.STALLED}, "it stalled: try this"),
        ({"unlike_noise": "what is left is no noise"}, "what is left is no noise"),
        ({"channels": "they are off alike"}, "they are off alike"),
        ({"chi2": 0.25}, "the noise that was given is 2 times what is left"),
        ({"result": jaxhf.Stop.MAX_STEPS}, "stopped by max_steps"),
        ({"strayed": 2.5}, "2.5 times its std"),
        ({"strayed": 2.5}, "do not use these heights before the cause is found: the scene does not explain the pictures, and"),
        ({"unlike_noise": "what is left is no noise", "strayed": None}, "may be further off than what they began from"),
        ({"seen": np.arange(20).reshape(4, 5) > 4}, "no picture shows 5 of 20 heights (25%): they are what the prior makes"),
        ({"seen": np.arange(20).reshape(4, 5) > 4, "strayed": None}, "they are a smooth continuation of their neighbours"),
        ({"seen": np.zeros((4, 5), bool), "strayed": None}, "they are the start"),
        ({"strayed": None, "same_light": True}, "same light and there is no prior"),
        ({"same_light": True}, "same light: slopes across it hardly show, and standard deviations are often too small"),
        ({"strayed": None, "mean_shown": False}, "not how high all of it stands"),
        ({"strayed": None, "noise_share": 0.3, "scaled": None}, "the noise is 30% of the pictures' brightness"),
        ({"scaled": 1.8}, "1.8 times the noise"),
        ({"displaced": (0.5, 1.2)}, "were off by 0.5, and are 1.2 times as large for it"),
        ({"draws": (20, 7)}, "interrupted after 7 of 20"),
        ({"unsure_noise": "heights explain 95%"}, "heights explain 95%: noise= tells the fit"),
        ({"length": "its length is too short"}, "its length is too short"),
        ({"strayed": 2.5}, "does not reflect as its material does"),
        ({"parts": (2.0, 0.3)}, "their mean ± 2, their shape ± 0.3"),
    ],
)
def test_warnings_say_what_speaks_against_the_heights(change, said):
    assert warnings(GOOD) == ()
    assert any(said in warning for warning in warnings(GOOD._replace(**change)))


def test_beside_a_prior_one_light_is_said_where_nothing_else_tells_slopes_and_deviations_were_asked_for():
    assert warnings(GOOD._replace(same_light=True, draws=(0, 0))) == ()
    assert warnings(GOOD._replace(same_light=True, same_view=False)) == ()


def test_a_fit_of_pictures_in_one_light_beside_a_prior_says_so():
    options = {"settings": SETTINGS, "noise": 0.01, "prior": jaxhf.Prior(0.05, 0.03, 0.2), "draws": 2, "max_steps": 3}
    found = jaxhf.fit(3 * scenes()[:1], 3 * pictures()[:1], **options)
    assert any("all pictures have the same light: slopes" in warning for warning in found.warnings)


def test_lights_are_the_same_that_come_from_one_direction():
    """Over the terrain as it lies: a lamp that moved, a sky beside the sun, a terrain that was turned are other lights."""

    def sun(azimuth: float, altitude: float = 40.0, **options) -> jaxhf.Directional:
        return jaxhf.Directional.from_angles(azimuth, altitude, **options)

    def lit(lights: list[Any], turn: float = 0.0) -> jaxhf.Scene:
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        place = np.array([[2 * c, -s, 0, 0], [2 * s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        ground = jaxhf.Object(jaxhf.Heightfield(TRUTH), jaxhf.Matte(0.5), place if turn else None)
        return jaxhf.Scene([ground], CAMERA, lights)

    lamps = [jaxhf.Point((0.5, 0.5, 2.0)), jaxhf.Point((0.5, 0.8, 2.0))]
    assert have_same_light([lit([sun(100)])])
    assert have_same_light([lit([sun(100)]), lit([sun(103, irradiance=(1.0, 2.0, 3.0))]), lit([sun(102, 42)])])
    assert not have_same_light([lit([sun(100)]), lit([sun(100)]), lit([sun(105.5)])])
    assert not have_same_light([lit([sun(100)]), lit([sun(220)])])
    assert not have_same_light([lit([sun(100)]), lit([sun(100), jaxhf.Sky(0.5)])])
    assert have_same_light([lit([sun(100), sun(220)]), lit([sun(220), sun(100)])])
    assert have_same_light([lit(lamps[:1]), lit(lamps[:1])])
    assert not have_same_light([lit(lamps[:1]), lit(lamps[1:])])
    assert have_same_light([lit([sun(100)], 30.0), lit([sun(200)], -70.0)])
    assert not have_same_light([lit([sun(100)], 30.0), lit([sun(100)], -70.0)])


def test_views_are_the_same_that_are_from_one_direction():
    """Towards the terrain's middle, as it lies; from a point, and from infinitely far away."""

    def seen(eye: tuple[float, float, float], place: Any = None, orthographic: bool = False) -> jaxhf.Scene:
        x, y, z = eye
        camera = jaxhf.Perspective.look_at(eye, (x, y, z - 1), up=(0, 1, 0))  # straight down, wherever it stands
        if orthographic:
            camera = jaxhf.Orthographic.look_at(eye, (0.5, 0.5, 0.05), up=(0, 1, 0))
        return jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(TRUTH), jaxhf.Matte(0.5), place)], camera)

    tilted = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 1], [0, 0, 0, 1]])
    assert have_same_view([seen((0.5, 0.5, 3.0))])
    assert have_same_view([seen((0.5, 0.5, 3.0)), seen((0.9, 0.5, 3.0)), seen((0.5, 0.5, 3.0), orthographic=True)])
    assert not have_same_view([seen((0.5, 0.5, 3.0)), seen((2.0, 0.5, 3.0))])
    assert not have_same_view([seen((0.5, 0.5, 3.0)), seen((2.0, 0.5, 3.0), orthographic=True)])
    assert not have_same_view([seen((0.5, 0.5, 3.0)), seen((0.5, 0.5, 3.0), tilted)])


def test_an_orthophoto_does_not_show_the_mean_height():
    """In either precision, at any noise; a picture by a camera at a finite distance does."""
    above = jaxhf.Orthographic.look_at((0.5, 0.5, 3), (0.5, 0.5, 0), up=(0, 1, 0), extent=0.9, width=24, height=24)
    for camera, shown in ((above, False), (CAMERA, True)):
        gradients = expanded(scenes(TRUTH, camera=camera), pictures(), settings=SETTINGS, noise=0.01).random_gradients()[0]
        assert shows_mean(gradients) == shown
        assert shows_mean(1e3 * gradients) == shown


def test_what_has_a_cause_needs_no_other_warning():
    """One thing to try is enough; and a small chi2 means nothing where the noise was estimated."""
    assert warnings(GOOD._replace(chi2=0.25, noise_given=False)) == ()
    for cause in ({"unlike_noise": "it is 1.5 times as bright"}, {"strayed": 2.5}):
        said = warnings(GOOD._replace(chi2=4.3, **cause))
        assert len(said) == 3  # not to use them, chi2, the cause
        assert not any("try this" in warning for warning in said)
