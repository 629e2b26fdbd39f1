"""A terrain that is fitted window by window."""

import dataclasses
import itertools
import re
from typing import Any

import numpy as np
import pytest

import jaxhf
from jaxhf.fitting import windows as _windows
from jaxhf.fitting.cropped import _fields, cropped, sides_in_sight, surroundings
from jaxhf.fitting.model.unknowns import Window, with_seam
from jaxhf.fitting.windows import divided, fit_windows
from jaxhf.scene.procedural import fractal

SIDE = 48
TRUTH = fractal([SIDE, SIDE], seed=5, exponent=2.6, range=(0.0, 0.15)).astype(np.float32)
LIGHTS = ((0.5, -0.3, 0.4), (0.3, 0.5, 0.4), (-0.5, 0.3, 0.4))
CAMERA = jaxhf.Perspective.look_at((3.5, -2.6, 1.8), (3.5, -1.5, 0.05), fov=36, width=48, height=48)
CAMERAS = {
    "perspective": CAMERA,
    "orthographic": jaxhf.Orthographic.look_at((3.5, -2.6, 1.8), (3.5, -1.5, 0), extent=1.1, width=48, height=40),
}
ABOVE = jaxhf.Orthographic.look_at((3.5, -1.5, 3), (3.5, -1.5, 0), up=(0, 1, 0), extent=0.9, width=48, height=48)
SETTINGS = jaxhf.Settings(samples=4, chunk=256)
STD = 0.01
WINDOW = Window(8, 16, 24, 24)
# From straight above, without shadows and a border in sight: points on edges take a minute to compile.
PLAIN = jaxhf.Settings(samples=4, chunk=256, shadows=False, edge_samples=0)
OPTIONS: dict[str, Any] = {"window": 32, "overlap": 16, "settings": PLAIN, "draws": 10}


def scenes(heights: Any, camera: Any = CAMERA, albedo: Any = 0.7) -> list[jaxhf.Scene]:
    field = jaxhf.Object(jaxhf.Heightfield(heights, x0=3.0, y0=-2.0), jaxhf.Matte(albedo))
    return [jaxhf.Scene([field], camera, [jaxhf.Directional(towards)]) for towards in LIGHTS]


def pictures() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    exact = [
        np.asarray(jaxhf.render(scene, jaxhf.Settings(samples=64, shadows=False)))[..., 0] for scene in scenes(TRUTH, ABOVE)
    ]
    return [image + 0.003 * rng.standard_normal(image.shape) for image in exact]


def known() -> jaxhf.Prior:
    rng = np.random.default_rng(1)
    return jaxhf.Prior(TRUTH + STD * rng.standard_normal(TRUTH.shape), STD)


@pytest.mark.parametrize(
    ("shape", "side", "overlap"), [((100, 40), 32, 8), ((20, 33), 32, 8), ((64, 64), 32, 2), ((33, 500), 64, 31)]
)
def test_windows_cover_a_terrain_and_overlap(shape, side, overlap):
    windows = divided(shape, side, overlap)
    covered = np.zeros(shape, int)
    for window in windows:
        covered[window.place] += 1
        assert (window.ny, window.nx) == tuple(min(side, n) for n in shape)
    assert covered.min() == 1
    for axis in (0, 1):
        begins = np.unique([window[axis] for window in windows])
        assert (np.diff(begins) <= side - overlap).all()
        assert len(begins) == max(1, -(-(shape[axis] - overlap) // (side - overlap)))


TEXELS = np.random.default_rng(3).uniform(0.3, 0.9, (SIDE, SIDE, 3)).astype(np.float32)
PAINTED = jaxhf.ImageTexture(TEXELS, at_vertices=True)


@pytest.mark.parametrize(
    ("name", "albedo", "count"),
    [
        ("perspective", PAINTED, 1),
        pytest.param("perspective", PAINTED, 3, marks=pytest.mark.slow),
        pytest.param("orthographic", 0.7, 3, marks=pytest.mark.slow),
    ],
)
def test_a_part_of_a_picture_shows_the_window_in_its_surroundings(name, albedo, count):
    """Where it counts it is the whole picture's part, with its texture and shadows from outside; the rim does not count."""
    whole = scenes(TRUTH, CAMERAS[name], albedo)[:count]
    images = [np.asarray(jaxhf.render(scene, SETTINGS)) for scene in whole]
    (around,) = surroundings(whole, (0.0, 0.15), [WINDOW])
    assert 24 < around.ny < SIDE
    terrain = TRUTH.astype(np.float64)
    parts = cropped(whole, images, [np.ones_like(image) for image in images], terrain, 0.0, WINDOW, around, ([], []))
    assert len(parts) == len(whole)
    for part in parts:
        assert part.scene.heightfields[0].heights.shape == (24, 24)
        shown, aovs = jaxhf.render(part.scene, SETTINGS, aovs=("object",))
        counts, number = part.weight[..., 0] > 0, np.asarray(aovs["object"])
        np.testing.assert_allclose(np.asarray(shown)[counts], part.target[counts], rtol=0, atol=2e-5)
        assert 0.25 < (counts & (number == 0)).sum() / (number == 0).sum() < 1
        assert not (counts & (number == 1)).any()


@pytest.mark.parametrize(
    ("lights", "camera", "expected"),
    [
        # A height of 0.1 above 0 hides light of slope 1 for 0.1, 4.7 cells, and two cells are to spare.
        ([jaxhf.Directional((1, 0, 1))], ABOVE, (6, 14, 28, 28 + 5)),
        ([jaxhf.Directional((0, -2, 1))], ABOVE, (0, 14, 24 + 8 + 2, 28)),
        ([jaxhf.Point((3.0, -1.7, 0.2))], ABOVE, (6, 6, 28, 36)),  # half of the way from the window to the light
        ([jaxhf.Directional((1, 0, -1))], ABOVE, (6, 14, 28, 34)),  # from below: all along its way
        ([jaxhf.Sky(1.0, occlusion=16)], ABOVE, (0, 0, SIDE, SIDE)),
        ([jaxhf.Sky(1.0)], jaxhf.Orthographic.look_at((3.5, -4.5, 3), (3.5, -1.5, 0), extent=0.9), (1, 14, 33, 28)),
    ],
)
def test_what_may_hide_a_window_is_around_it(lights, camera, expected):
    field = jaxhf.Heightfield(np.zeros((SIDE, SIDE), np.float32), x0=3.0, y0=-2.0)
    scene = jaxhf.Scene([jaxhf.Object(field)], camera, lights)
    assert surroundings([scene], (0.0, 0.1), [WINDOW]) == [Window(*expected)]
    both = surroundings([scene], (0.0, 0.1), [WINDOW, Window(0, 0, 24, 24)])
    assert both[0][2:] == both[1][2:]
    for window, around in zip([WINDOW, Window(0, 0, 24, 24)], both, strict=True):
        assert around.y <= window.y
        assert around.x <= window.x
        assert around.y + around.ny >= window.y + window.ny
        assert around.x + around.nx >= window.x + window.nx
        assert max(around.y + around.ny, around.x + around.nx) <= SIDE


def test_a_window_at_a_seam_has_its_part_of_it():
    """So that its heights are held there, as those of the whole terrain."""
    region = jaxhf.Heightfield(np.zeros((20, 20), np.float32), 8 / (SIDE - 1), x0=2.7, y0=-2.3)
    terrain, _ = jaxhf.nested(jaxhf.Heightfield(TRUTH, x0=3.0, y0=-2.0), region)
    window = Window(0, 4, 12, 12)
    part, around = _fields(terrain, np.asarray(terrain.heights), window, Window(0, 2, 20, 30))
    np.testing.assert_array_equal(part.seam, np.asarray(terrain.seam)[window.place])
    np.testing.assert_array_equal(around.seam, np.asarray(terrain.seam)[:20, 2:32])
    held = np.isfinite(np.asarray(terrain.seam)).all(-1)
    begin = with_seam(terrain, np.asarray(terrain.heights) + 0.3)  # as `fit_windows` begins from a start
    np.testing.assert_array_equal(begin[held], np.asarray(terrain.heights)[held])
    assert (begin != np.asarray(terrain.heights))[~held].all()


@pytest.mark.slow
def test_windows_come_near_the_truth_without_seams():
    """As near as one fit of all; where windows join, steps in the error are those of the rest."""
    targets = pictures()
    found = fit_windows(scenes(known().heights, ABOVE), targets, prior=known(), **OPTIONS)
    error = found.heights - TRUTH
    at_once = np.asarray(jaxhf.fit(scenes(known().heights, ABOVE), targets, prior=known(), settings=PLAIN).heights) - TRUTH
    assert np.std(error[found.seen]) < 1.2 * np.std(at_once[found.seen]) < 0.6 * STD
    assert found.std is not None
    deviation = np.median(found.std[found.seen])
    for done in found.windows[1:]:
        assert done.seam < np.sqrt(2) * deviation  # of two estimates
    for along in (np.abs(np.diff(error, axis=0)), np.abs(np.diff(error, axis=1)).T):
        joint, rest = along[[15, 31]].mean(), np.delete(along, [15, 16, 30, 31], axis=0).mean()
        assert joint < 1.5 * rest


class Fits:
    """In place of `fit`: the truth, off by a number of each window's own but where heights are held, with its deviation."""

    def __init__(self, stop: int = -1, off: float = 0.01):
        self.given, self.stop, self.off = [], stop, off

    def __call__(self, scenes: Any, targets: Any, **given: Any) -> Any:
        if len(self.given) == self.stop:
            raise KeyboardInterrupt
        self.given.append((scenes, given))
        prior, field = given["prior"], scenes[0].heightfields[0]
        y, x = round((field.y0 + 2) * (SIDE - 1)), round((field.x0 - 3) * (SIDE - 1))
        heights = TRUTH[y : y + 32, x : x + 32] + self.off * (1 + y + 2 * x)
        shape = heights.shape
        return jaxhf.Fit(
            heights=np.where(np.isnan(prior.held), heights, prior.held).astype(np.float32), result=jaxhf.Stop.CONVERGED,
            std=np.full(shape, 1.0 + y), samples=None, seen=np.ones(shape, bool), albedo=None, exposures=None, offsets=None,
            noise=np.ones(3), scenes=(), settings=PLAIN, images=(), residuals=(), regions=(), warnings=("said",),
            stats={"steps": 3, "seconds": 1.0, "chi2": 1.0}, history=(),
        )  # fmt: skip


def test_windows_go_over_into_one_another(tmp_path, monkeypatch):
    """Rims in what was fitted before are held at that; in overlaps heights and deviations change without a step."""
    targets, fits = [np.zeros((48, 48), np.float32)] * 3, Fits()
    options: dict[str, Any] = {"prior": known(), "noise": [0.1, 0.2, 0.3], **OPTIONS}
    monkeypatch.setattr(_windows, "fit", fits)
    found = fit_windows(scenes(TRUTH, ABOVE), targets, **options)
    assert [(done.y, done.x) for done in found.windows] == [(0, 0), (0, 16), (16, 0), (16, 16)]
    held = [np.isfinite(given["prior"].held) for _, given in fits.given]
    assert [mask.sum() for mask in held] == [0, 32, 32, 63]
    assert held[1][:, 0].all()
    assert held[2][0].all()
    np.testing.assert_array_equal(fits.given[1][1]["prior"].held[:, 0], np.asarray(TRUTH + 0.01, np.float64)[:32, 16])
    np.testing.assert_array_equal(fits.given[0][1]["noise"], [0.1, 0.2, 0.3])
    off = found.heights - TRUTH
    np.testing.assert_allclose(off[:16, :17], 0.01, atol=1e-6)
    np.testing.assert_allclose(off[:16, 32:], 0.33, atol=1e-6)
    np.testing.assert_allclose(np.diff(off[:16, 16:33], axis=1), 0.02, atol=1e-6)
    assert np.abs(np.diff(off, axis=0)).max() < 0.03  # at corners where four meet; windows differ by 0.16 and 0.32
    assert found.std is not None
    np.testing.assert_allclose(found.std[:, 4], np.interp(np.arange(SIDE), [16, 32], [1, 17]))
    np.testing.assert_allclose(found.windows[1].seam, 0.32, rtol=1e-5)
    assert re.fullmatch(rf"Mosaic\({SIDE} x {SIDE}, heights [-\d.]+ \.\. [\d.]+ ± [\d.]+, \d windows\)", repr(found))
    # Cut short in the third window, it goes on from its file.
    path = tmp_path / "windows"
    monkeypatch.setattr(_windows, "fit", Fits(2))
    with pytest.raises(KeyboardInterrupt):
        fit_windows(scenes(TRUTH, ABOVE), targets, checkpoint=jaxhf.Checkpoint(path), **options)
    rest = Fits()
    monkeypatch.setattr(_windows, "fit", rest)
    again = jaxhf.Checkpoint(path, resume=True)
    other = fit_windows(scenes(TRUTH, ABOVE), targets, checkpoint=again, **options)
    assert len(rest.given) == 2
    np.testing.assert_array_equal(other.heights, found.heights)
    np.testing.assert_array_equal(other.std, found.std)
    assert repr(other.windows) == repr(found.windows)  # nan is a number there
    with pytest.raises(ValueError, match="another fit"):
        jaxhf.fit(scenes(TRUTH, ABOVE), targets, prior=known(), settings=PLAIN, checkpoint=again)
    options["overlap"] = 12
    with pytest.raises(ValueError, match="another fit"):
        fit_windows(scenes(TRUTH, ABOVE), targets, checkpoint=again, **options)


def test_what_is_around_a_window_may_rise_to_its_prior(monkeypatch):
    """Also where the scenes, and so the start, are flat: as much is around it as of a start from the prior."""
    sizes = []
    for start, mean in ((TRUTH, TRUTH), (0 * TRUTH, TRUTH), (0 * TRUTH, 0 * TRUTH)):
        fits = Fits()
        monkeypatch.setattr(_windows, "fit", fits)
        prior = jaxhf.Prior(mean, np.full(TRUTH.shape, 1e-3))
        fit_windows(scenes(start, ABOVE), [np.zeros((48, 48), np.float32)] * 3, **OPTIONS | {"prior": prior, "noise": 0.1})
        sizes.append(fits.given[0][0][0].objects[-1].shape.heights.shape)
    assert sizes[0] == sizes[1]
    assert sizes[2] < sizes[1] < (SIDE, SIDE)


def test_pictures_of_windows_have_few_sizes(monkeypatch):
    """So they share programs, although a window that is nearer to the camera fills more of a picture."""
    whole, order = scenes(TRUTH, dataclasses.replace(CAMERA, width=150, height=150)), divided(TRUTH.shape, 32, 8)
    needed = [sides_in_sight(whole, TRUTH.astype(float), 0.0, [window]) for window in order]
    assert len({tuple(rows) for rows, _ in needed}) > 1
    fits = Fits(off=0.0)
    monkeypatch.setattr(_windows, "fit", fits)
    options: dict[str, Any] = OPTIONS | {"overlap": 8, "prior": known(), "noise": 0.1}
    fit_windows(whole, [np.zeros((150, 150), np.float32)] * 3, **options)
    sizes = {(scene.camera.height, scene.camera.width) for given in fits.given for scene in given[0]}
    assert len(fits.given) == len(order)
    assert len(sizes) == 1


def test_a_window_at_the_camera_does_not_enlarge_the_others():
    """It is seen all over the picture, or so a box around it behind the camera has it; what needs far less has less."""
    near = jaxhf.Perspective.look_at((3.1, -1.9, 0.16), (3.5, -1.5, 0.1), fov=60, width=800, height=600)
    rows, columns = sides_in_sight(scenes(TRUTH, near), TRUTH.astype(float), 0.0, divided(TRUTH.shape, 16, 4))
    assert (rows[-1], columns[-1]) == (608, 800)
    assert len(rows) > 1
    assert rows[0] < 300
    for sides in (rows, columns):
        assert all(more > 1.4 * less for less, more in itertools.pairwise(sides))


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"prior": None}, "prior must be a jaxhf.Prior, it is None"),
        ({"window": 8}, "window must be a whole number from 32"),
        ({"overlap": 17}, "overlap must be"),
        ({"unknown": jaxhf.Unknown(exposures=True)}, "unknown must be left out"),
    ],
)
def test_what_windows_cannot_be_is_refused(wrong: Any, text: str):
    targets = [np.zeros((48, 48), np.float32)] * 3
    options: dict[str, Any] = {"prior": known(), **OPTIONS, **wrong}
    with pytest.raises(ValueError, match=text):
        fit_windows(scenes(TRUTH), targets, **options)
