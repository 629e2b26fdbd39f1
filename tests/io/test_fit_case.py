"""What a fit file says is what `fit` gets; what is wrong in it is named with its line. Nothing here is traced."""

import re
from typing import Any

import numpy as np
import pytest
from PIL import Image

import jaxhf
from jaxhf.io.georeference import CoordinateSystem
from jaxhf.io.resample import at_vertices
from jaxhf.io.toml.fit import load_case

SCENE = """[camera]
type = "perspective"
eye = [0.5, 0.5, 3.0]
target = [0.5, 0.5, 0]
up = [0, 1, 0]

[[lights]]
type = "directional"

[[objects]]
shape = "heightfield"
heights = [[0, 1, 2], [3, 4, 5], [6, 7, 9]]
"""
PICTURE = """
[[pictures]]
image = "grey.npy"
"""
ALL = (
    "samples = 4\n"
    + SCENE
    + """
[[pictures]]
image = "grey.npy"
mask = "mask.png"
noise = 0.5

[[pictures]]
image = "colour.npy"
weights = "weights.npy"
lights = [{ type = "sky", radiance = 1 }]
[pictures.camera]
type = "orthographic"
eye = [0.5, 0.5, 3.0]
target = [0.5, 0.5, 0]
up = [0, 1, 0]
extent = 2

[fit]
noise = 0.02
start = 3
prior = "prior.npy"
prior_std = 0.5
prior_length = 4
prior_exponent = 3
smoothness = 2
albedo = "map"
albedo_smoothness = 1
exposures = true
offsets = false
light_std = 1
camera_std = [2, 0.5]
loss = "huber"
loss_scale = 2
solver = "bfgs"
levels = [0.5, 1]
max_steps = 7
inner_steps = 8
tolerance = 1e-3
uncertainty = "exact"
checkpoint_every = 3

[settings]
shadows = false
samples = 9
"""
)


@pytest.fixture
def folder(tmp_path):
    grey = np.arange(12, dtype=np.float32).reshape(3, 4)
    np.save(tmp_path / "grey.npy", grey)
    np.save(tmp_path / "colour.npy", np.stack([grey, 2 * grey, 3 * grey], axis=-1))
    np.save(tmp_path / "weights.npy", grey / 4)
    np.save(tmp_path / "prior.npy", np.arange(9.0).reshape(3, 3))
    jaxhf.save_image(tmp_path / "mask.png", (grey > 5) * 0.1)
    return tmp_path


def case(folder, text):
    (folder / "case.toml").write_text(text)
    return load_case(folder / "case.toml", np.float64)


def test_every_key_arrives(folder):
    found = case(folder, ALL)
    assert found.names == ("grey.npy", "colour.npy")
    assert [target.shape for target in found.targets] == [(3, 4, 3), (3, 4, 3)]
    assert found.noise == (0.5, 0.02)
    np.testing.assert_array_equal(found.weights[0], np.arange(12).reshape(3, 4) > 5)
    np.testing.assert_array_equal(found.weights[1], np.arange(12).reshape(3, 4) / 4)
    assert found.settings == jaxhf.Settings(shadows=False, samples=9)
    np.testing.assert_array_equal(found.options.pop("prior"), np.arange(9).reshape(3, 3))
    assert found.options == {
        "start": 3, "prior_std": 0.5, "prior_length": 4, "prior_exponent": 3, "smoothness": 2, "albedo": "map",
        "albedo_smoothness": 1, "exposures": True, "offsets": False, "light_std": 1,
        "camera_std": [2, 0.5], "loss": "huber", "loss_scale": 2, "solver": "bfgs",
        "levels": [0.5, 1], "max_steps": 7,
        "inner_steps": 8, "tolerance": 1e-3, "uncertainty": "exact", "checkpoint_every": 3,
    }  # fmt: skip
    first, second = found.scenes
    assert first.heights is second.heights
    assert first.heights.dtype == np.float64
    assert first.samples == second.samples == 4
    assert isinstance(first.camera, jaxhf.Perspective)
    assert isinstance(second.camera, jaxhf.Orthographic)
    assert (first.camera.width, first.camera.height) == (second.camera.width, second.camera.height) == (4, 3)
    assert isinstance(first.lights[0], jaxhf.Directional)
    assert isinstance(second.lights[0], jaxhf.Sky)


@pytest.mark.parametrize(("dtype", "top"), [(np.uint8, 255), (np.uint16, 65535)])
def test_weights_in_a_png_are_no_colours(folder, dtype, top):
    """Their share of the top, not what sRGB makes of it; a mask is what is not black."""
    stored = np.array([[0, 1, 2, 3], [128, 100, 50, 4], [255, 200, 7, 9]], dtype)
    Image.fromarray(stored).save(folder / "weights.png")
    (weights,) = case(folder, WHOLE + 'weights = "weights.png"\n').weights
    np.testing.assert_allclose(np.asarray(weights), stored / top, rtol=1e-6)
    (weights,) = case(folder, WHOLE + 'mask = "weights.png"\n').weights
    np.testing.assert_array_equal(weights, stored > 0)


def test_what_a_picture_holds_is_for_the_file_to_say(folder):
    """Whole numbers are sRGB, or linear; a texture's as well."""
    stored = np.full((3, 4), 30000, np.uint16)
    Image.fromarray(stored).save(folder / "deep.png")
    share = 30000 / 65535
    for transfer, value in (("linear", share), ("srgb", ((share + 0.055) / 1.055) ** 2.4)):
        given = f'image = "deep.png"\ntransfer = "{transfer}"\n'
        painted = SCENE + f'albedo = "grey"\n[textures.grey]\n{given}\n[[pictures]]\n{given}'
        found = case(folder, painted)
        np.testing.assert_allclose(found.targets[0], value, rtol=1e-6)
        material: Any = found.scenes[0].objects[0].material
        np.testing.assert_allclose(material.albedo.texels, value, rtol=1e-6)


def test_orthophotos_and_masks_of_geographic_programs(folder):
    """Pixels without data do not count, with a mask and without one."""
    rasterio = pytest.importorskip("rasterio")
    place = {"driver": "GTiff", "width": 4, "height": 3, "count": 1, "transform": rasterio.Affine(30, 0, 5e5, 0, -30, 4.1e6)}
    seen = np.arange(12, dtype=np.uint8).reshape(3, 4)
    for name, values, nodata in (("seen.tif", seen, 0), ("mask.tif", np.where(seen < 6, 255, 1).astype(np.uint8), 255)):
        with rasterio.open(folder / name, "w", dtype="uint8", crs="EPSG:32616", nodata=nodata, **place) as file:
            file.write(values, 1)
    alone = case(folder, SCENE + '[[pictures]]\nimage = "seen.tif"\ntransfer = "linear"\n')
    np.testing.assert_allclose(alone.targets[0][..., 0], np.where(seen == 0, np.nan, seen / 255), rtol=1e-6)
    np.testing.assert_array_equal(alone.weights[0], seen > 0)
    np.testing.assert_array_equal(case(folder, WHOLE + 'mask = "mask.tif"\n').weights[0], seen >= 6)
    both = case(folder, SCENE + '[[pictures]]\nimage = "seen.tif"\nweights = "weights.npy"\n')
    np.testing.assert_array_equal(both.weights[0], np.arange(12).reshape(3, 4) / 4 * (seen > 0))


def test_what_is_not_given_is_left_to_fit(folder):
    found = case(folder, SCENE + PICTURE)
    assert found.options == {}
    assert found.weights == (None,)
    assert found.noise is None
    assert found.settings == jaxhf.Settings()
    assert found.like is None


@pytest.mark.parametrize("ending", ["toml", "pbrt"])
def test_a_scene_may_lie_in_a_file_of_its_own(folder, ending):
    """Its camera's size becomes that of the picture, which has its proportions."""
    pbrt = """LookAt 0.5 0.5 3  0.5 0.5 0  0 1 0
Camera "perspective" "float fov" [45]
Film "image" "integer xresolution" [40] "integer yresolution" [30]
WorldBegin
LightSource "distant"
Shape "heightfield" "integer nu" [3] "integer nv" [3] "float Pz" [0 1 2 3 4 5 6 7 9]
WorldEnd
"""
    sized = SCENE.replace("up =", "width = 40\nheight = 30\nup =")
    (folder / f"scene.{ending}").write_text(pbrt if ending == "pbrt" else sized)
    found = case(folder, f'scene = "scene.{ending}"\n{PICTURE}')
    assert (found.scenes[0].camera.width, found.scenes[0].camera.height) == (4, 3)
    assert found.scenes[0].heights[2, 2] == 9
    assert len(found.scenes[0].lights) == 1


def test_the_map_of_a_geotiff_is_kept_unless_the_scene_puts_it_elsewhere(folder):
    pytest.importorskip("tifffile")
    jaxhf.save_heights(folder / "dem.tif", jaxhf.Terrain(np.ones((3, 3))))
    field = 'shape = "heightfield"\nfile = "dem.tif"\n'
    scene = SCENE[: SCENE.index("shape")]
    assert case(folder, scene + field + PICTURE).like == folder / "dem.tif"
    assert case(folder, scene + field + "x0 = 3\n" + PICTURE).like is None


def terrain_file(path, place, shape, holes=()):
    """Heights that rise by 1 to the east and by 2 to the north for each unit of the map, on a plane: the same by any grid."""
    dx, dy, x0, y0 = place
    heights = (x0 + dx * np.arange(shape[1])) + 2 * (y0 + dy * np.arange(shape[0]))[:, None]
    heights[tuple(np.array(holes, int).reshape(-1, 2).T)] = np.nan
    if path.name.startswith("degrees"):  # they start in the north, and their bounds are half a cell further out
        bounds = {"xmin": x0 - dx / 2, "ymin": y0 - dy / 2, "ymax": 90}
        np.savez(path, elevation=heights[::-1], dx=dx, dy=dy, **bounds)
    else:
        jaxhf.save_heights(path, jaxhf.Terrain(heights, *place))
    return heights


def with_prior(tile, prior, more=""):
    field = SCENE[: SCENE.index("heights =")] + f'file = "{tile}"\n{more}'
    return field + PICTURE + f'\n[fit]\nprior = "{prior}"\nstart = "{prior}"\nprior_std = "{prior}"\n'


TILE = (30.0, 20.0, 500000.0, 4100000.0)  # of 4 x 5 vertices: 120 by 60
REGIONS = {
    "larger": (TILE, (90.0, 70.0, 499700.0, 4099900.0), (5, 9)),
    "of the same size": (TILE, TILE, (4, 5)),
    # Rasters with the same corners: the centres of larger pixels lie further inside.
    "coarse": (TILE, (75.0, 40.0, 500022.5, 4100010.0), (2, 2)),
    "degrees": ((0.01, 0.01, 10.0, 45.0), (0.02, 0.03, 9.96, 44.9), (6, 7)),
    "degrees from 0 on": ((0.01, 0.01, -10.0, 45.0), (0.02, 0.03, 349.96, 44.9), (6, 7)),
}


@pytest.mark.parametrize("name", REGIONS)
def test_a_prior_lies_where_its_file_says(folder, name):
    tile, region, shape = REGIONS[name]
    ending = "degrees.npz" if "degrees" in name else "utm.npz"
    expected = terrain_file(folder / ending, tile, (4, 5))
    prior = ending.replace(".", "_prior.")
    held = terrain_file(folder / prior, region, shape)
    found = case(folder, with_prior(ending, prior)).options
    if name == "coarse":
        inside = found["prior"][1:3, 1:4]
        np.testing.assert_allclose(inside, expected[1:3, 1:4], rtol=1e-12)
        np.testing.assert_array_equal(found["prior"][[0, 0, -1, -1], [0, -1, 0, -1]], held.ravel())
    else:
        shift = 360 * (name == "degrees from 0 on")
        np.testing.assert_allclose(found["prior"], expected + shift, rtol=1e-12)
    for option in ("start", "prior_std"):
        np.testing.assert_array_equal(found[option], found["prior"])
    # Without a place, or over a terrain without one, it is left to `fit`.
    np.save(folder / "bare.npy", held)
    assert case(folder, with_prior(ending, "bare.npy")).options["prior"].shape == shape
    np.save(folder / "tile.npy", expected)
    assert case(folder, with_prior("tile.npy", prior)).options["prior"].shape == shape
    placed = dict(zip(("dx", "dy", "x0", "y0"), tile, strict=True))
    placed = "".join(f"{key} = {value}\n" for key, value in placed.items())
    if "degrees" in name:
        with pytest.raises(
            jaxhf.SceneError, match=r":23: fit\.start: it must lie in the coordinates of the terrain, .* degrees"
        ):
            case(folder, with_prior("tile.npy", prior, placed))
    else:
        np.testing.assert_array_equal(case(folder, with_prior("tile.npy", prior, placed)).options["prior"], found["prior"])


def test_a_prior_covers_the_terrain(folder):
    terrain_file(folder / "tile.npz", TILE, (4, 5))
    terrain_file(folder / "east.npz", (30.0, 20.0, 500016.0, 4100000.0), (4, 5))
    message = (
        r":19: fit\.start: it must cover the terrain, whose x goes from 500000 to 500120; "
        r"its own goes from 500016 to 500136"
    )
    with pytest.raises(jaxhf.SceneError, match=message):
        case(folder, with_prior("tile.npz", "east.npz"))
    terrain_file(folder / "north.npz", (30.0, 20.0, 500000.0, 4100011.0), (4, 5))
    with pytest.raises(jaxhf.SceneError, match="whose y goes from 4100000 to 4100060; its own goes from 4100011 to 4100071"):
        case(folder, with_prior("tile.npz", "north.npz"))
    with pytest.raises(ValueError, match=r"it must have the terrain's coordinates, EPSG:32617; it has EPSG:32616"):
        at_vertices(*(jaxhf.Terrain(np.zeros((2, 2)), *TILE, CoordinateSystem(code=code)) for code in (32616, 32617)))


def test_a_hole_in_a_prior_is_an_error_where_the_terrain_is(folder):
    terrain_file(folder / "tile.npz", TILE, (4, 5))
    region = (30.0, 20.0, 499970.0, 4099980.0)
    border = [(0, k) for k in range(7)] + [(k, 6) for k in range(6)]
    whole = terrain_file(folder / "region.npz", region, (6, 7), holes=border)
    np.testing.assert_allclose(case(folder, with_prior("tile.npz", "region.npz")).options["prior"], whole[1:5, 1:6])
    terrain_file(folder / "region.npz", region, (6, 7), holes=[*border, (2, 3)])
    with pytest.raises(
        jaxhf.SceneError,
        match=r":19: fit\.start: it must have a height everywhere, 1 of 20 are holes; the first is row 1 column 2",
    ):
        case(folder, with_prior("tile.npz", "region.npz"))
    np.save(folder / "bare.npy", np.array([[1, 2], [np.nan, 3]]))
    with pytest.raises(jaxhf.SceneError, match="1 of 4 are holes; the first is row 1 column 0"):
        case(folder, with_prior("tile.npz", "bare.npy"))


def test_scale_and_nodata_hold_for_priors_too(folder):
    terrain_file(folder / "tile.npz", TILE, (4, 5))
    np.save(folder / "bare.npy", np.array([[1.0, 2], [3, 4]]))
    found = case(folder, with_prior("tile.npz", "bare.npy", "z_scale = -2\n")).options
    np.testing.assert_array_equal(found["prior"], [[-2, -4], [-6, -8]])
    np.testing.assert_array_equal(found["prior_std"], [[2, 4], [6, 8]])
    with pytest.raises(jaxhf.SceneError, match="1 of 4 are holes; the first is row 1 column 0"):
        case(folder, with_prior("tile.npz", "bare.npy", "nodata = 3\n"))


def test_the_files_own_nodata_goes_before_the_terrains(folder):
    tifffile = pytest.importorskip("tifffile")
    terrain_file(folder / "tile.npz", TILE, (4, 5))
    heights = np.array([[1.0, 2], [-9999, 3]], np.float32)
    tifffile.imwrite(folder / "tagged.tif", heights, photometric="minisblack", extratags=[(42113, "s", 0, "-9999", True)])
    with pytest.raises(jaxhf.SceneError, match="1 of 4 are holes; the first is row 0 column 0"):
        case(folder, with_prior("tile.npz", "tagged.tif", "nodata = 3\n"))


def test_a_terrain_that_is_moved_and_scaled_in_the_scene_is_still_its_own_prior(folder):
    heights = terrain_file(folder / "tile.npz", TILE, (4, 5))
    found = case(folder, with_prior("tile.npz", "tile.npz", "dx = 9.0\ndy = 6.0\nx0 = 0\ny0 = 0\n")).options
    np.testing.assert_array_equal(found["prior"], heights)


WHOLE = SCENE + PICTURE
BAD = {
    "unknown key": (WHOLE + "\n[fits]\n", r":17: unknown key 'fits'; did you mean 'fit'"),
    "unknown option": (WHOLE + "\n[fit]\nmax_step = 3\n", r":18: unknown key 'max_step' in fit; did you mean 'max_steps'"),
    "unknown setting": (WHOLE + "\n[settings]\nshadow = true\n", r":18: unknown key 'shadow' in settings"),
    "unknown transfer": (
        WHOLE + 'transfer = "log"\n',
        r":16: pictures\[0\]\.transfer must be one of srgb, linear; it is 'log'",
    ),
    "unknown key of a picture": (WHOLE + "images = 1\n", r":16: unknown key 'images' in pictures\[0\]"),
    "wrong type": (WHOLE + "\n[fit]\nexposures = 1\n", r":18: fit\.exposures must be true or false, it is 1"),
    "wrong start": (WHOLE + "\n[fit]\nstart = [1]\n", r":18: fit\.start must be a finite number or a string, it is \[1\]"),
    "wrong levels": (WHOLE + '\n[fit]\nlevels = ["a"]\n', r":18: fit\.levels must be a list of finite numbers"),
    "wrong uncertainty": (WHOLE + "\n[fit]\nuncertainty = 1.5\n", r":18: fit\.uncertainty must be a whole number or a string"),
    "bad setting": (WHOLE + "\n[settings]\nsamples = 3\n", r":18: settings\.samples must be a square number"),
    "no pictures": (SCENE, r": a fit must have 'pictures', .* this is a scene"),
    "an empty list": ("pictures = []\n" + SCENE, r":1: pictures must hold at least one picture"),
    "no image": (SCENE + "[[pictures]]\n", r":13: pictures\[0\] must have 'image'"),
    "an image that is not there": (WHOLE.replace("grey", "gray"), r":15: pictures\[0\]\.image: there is no file 'gray\.npy'"),
    "an image outside": (WHOLE.replace("grey", "../grey"), r":15: pictures\[0\]\.image: '\.\./grey\.npy' lies outside"),
    "no image in the file": (WHOLE.replace("grey.npy", "case.toml"), r":15: pictures\[0\]\.image: .*cannot read an image"),
    "no objects": (PICTURE, r": a fit must have 'scene', .* or 'objects'"),
    "scene and tables": ('scene = "x.toml"\n' + WHOLE, r":2: camera must stand without scene"),
    "a scene that is none": ('scene = "grey.npy"\n' + PICTURE, r":1: scene: .*cannot read a scene from"),
    "no camera": (WHOLE[WHOLE.index("[[lights]]") :], r":8: pictures\[0\] must have a camera"),
    "mask and weights": (
        WHOLE + 'mask = "mask.png"\nweights = "grey.npy"\n',
        r":17: pictures\[0\] must have mask or weights, it has both",
    ),
    "a mask of another size": (
        WHOLE + 'mask = "prior.npy"\n',
        r":16: pictures\[0\]\.mask must have the size of the image, 4 x 3 pixels; it is 3 x 3 pixels",
    ),
    "another size": (
        WHOLE.replace("up =", "width = 50\nheight = 30\nup ="),
        r":17: pictures\[0\]\.image must have the proportions of its camera, 50 x 30 pixels; it is 4 x 3 pixels",
    ),
    "noise of all": (WHOLE + "\n[fit]\nnoise = -1\n", r":18: fit\.noise must be positive, it is -1"),
    "noise of a picture": (WHOLE + "noise = 0\n", r":16: pictures\[0\]\.noise must be positive, it is 0"),
    "two skies": (
        WHOLE + 'lights = [{ type = "sky", radiance = 1 }, { type = "sky", radiance = 1 }]\n',
        r":16: pictures\[0\]\.lights may hold one Sky",
    ),
    "a light of a picture": (
        WHOLE + '[[pictures.lights]]\ntype = "sky"\nradience = 1\n',
        r":18: unknown key 'radience' in pictures\[0\]\.lights\[0\]",
    ),
    "a prior that is no terrain": (WHOLE + '\n[fit]\nprior = "colour.npy"\n', r":18: fit\.prior: .*shape \(ny, nx\)"),
    "not TOML": (WHOLE + "\n[fit\n", r":17: this is not TOML"),
}


@pytest.mark.parametrize("name", BAD)
def test_mistakes_are_named_with_their_line(folder, name):
    text, message = BAD[name]
    with pytest.raises(jaxhf.SceneError, match=rf"^{folder}/case\.toml{message}"):
        case(folder, text)


def test_a_case_must_be_toml(folder):
    with pytest.raises(ValueError, match=r"grey\.npy: cannot read what to fit from the ending '\.npy'"):
        load_case(folder / "grey.npy")
    with pytest.raises(FileNotFoundError, match=r"none\.toml: there is no such file"):
        load_case(folder / "none.toml")


LOCATED = {
    "max_steps": (WHOLE + "\n[fit]\nmax_steps = 0\n", r":18: fit\.max_steps must be a whole number from 1 on, it is 0"),
    "loss": (WHOLE + '\n[fit]\nloss = "l2"\n', r":18: fit\.loss must be one of squares, huber, cauchy, geman; it is 'l2'"),
    "prior_std": (WHOLE + "\n[fit]\nprior = 0\n", r":18: fit\.prior must stand with prior_std"),
    "target": (WHOLE.replace("grey", "nan"), r":15: pictures\[0\]\.image must be finite where .*; row 0 column 1"),
    "weights": (WHOLE + 'mask = "nothing.npy"\n', r":16: pictures\[0\]\.mask must be finite, from 0 on, not all 0"),
}


@pytest.mark.parametrize("name", LOCATED)
def test_what_fit_refuses_is_named_with_its_line(folder, name):
    text, message = LOCATED[name]
    np.save(folder / "nan.npy", np.array([[0.0, np.nan, 1.0], [0.0, 0.0, 1.0]]))
    np.save(folder / "nothing.npy", np.zeros((3, 4)))
    given = case(folder, text)
    with pytest.raises(jaxhf.ArgumentError, match=r"^fit: ") as refused:
        jaxhf.fit(given.scenes, given.targets, weights=given.weights, noise=given.noise, **given.options)
    assert re.match(rf"{folder}/case\.toml{message}", str(given.located(refused.value)))
