"""What a fit file says is what `fit` gets; what is wrong in it is named with its line. Nothing here is traced."""

import dataclasses
import re
from typing import Any

import geotiffs
import numpy as np
import pytest
from PIL import Image

import jaxhf
from jaxhf.io.scenes.toml.fit import load_case
from jaxhf.io.terrain.georeference import CoordinateSystem
from jaxhf.io.terrain.resample import at_vertices

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
FROM_ABOVE = '{ type = "orthographic", eye = [0.5, 0.5, 3.0], target = [0.5, 0.5, 0], up = [0, 1, 0], extent = 2 }'
ALL = f"""samples = 4
settings = {{ shadows = false, samples = 9 }}
{SCENE}
[[pictures]]
image = "grey.npy"
mask = "mask.png"
noise = 0.5

[[pictures]]
image = "colour.npy"
weights = "weights.npy"
lights = [{{ type = "sky", radiance = 1 }}]
camera = {FROM_ABOVE}

[fit]
start = 3
noise = 0.02
draws = 9
max_steps = 7
prior = {{ heights = "prior.npy", std = 0.5, length = 4 }}

[fit.unknown]
albedo = "map"
albedo_std = 0.5
albedo_length = 3
albedo_shared = true
sky_std = 0.7
exposures = true
offsets = false
material_std = {{ limb = 0.2 }}
light_std = 1
camera_std = [2, 0.5]
"""
WHOLE = SCENE + PICTURE


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
    return load_case(folder / "case.toml")


def test_every_key_arrives(folder):
    found = case(folder, ALL)
    assert found.names == ("grey.npy", "colour.npy")
    assert [target.shape for target in found.targets] == [(3, 4, 3), (3, 4, 3)]
    assert found.noise == (0.5, 0.02)
    np.testing.assert_array_equal(found.weights[0], np.arange(12).reshape(3, 4) > 5)
    np.testing.assert_array_equal(found.weights[1], np.arange(12).reshape(3, 4) / 4)
    assert found.settings == jaxhf.Settings(shadows=False, samples=9)
    np.testing.assert_array_equal(found.prior.pop("heights"), np.arange(9).reshape(3, 3))
    assert (found.options, found.prior) == ({"start": 3, "draws": 9, "max_steps": 7}, {"std": 0.5, "length": 4})
    assert tuple(found.unknown.values()) == ("map", 0.5, 3, 0.7, 1, True, True, False, [2, 0.5], {"limb": 0.2})
    assert found.unknown.keys() == {field.name for field in dataclasses.fields(jaxhf.Unknown)}
    first, second = found.scenes
    assert first.heights is second.heights
    assert first.heights.dtype == np.float32
    assert first.samples == second.samples == 4
    assert isinstance(first.camera, jaxhf.Perspective)
    assert isinstance(second.camera, jaxhf.Orthographic)
    assert (first.camera.width, first.camera.height) == (second.camera.width, second.camera.height) == (4, 3)
    assert isinstance(first.lights[0], jaxhf.Directional)
    assert isinstance(second.lights[0], jaxhf.Sky)


def test_a_detectors_noise_is_a_table(folder):
    """Of all pictures, and of one that says another."""
    text = PICTURE + PICTURE + "noise = { read = 1, nodata = 9 }\n" + PICTURE + "noise = 0.5\n"
    found = case(folder, SCENE + text + "[fit.noise]\nread = 0.1\ngain = 0\nsaturation = 2\n")
    first = {"read": 0.1, "gain": 0, "saturation": 2}
    assert found.noise == (first, {"read": 1, "nodata": 9}, 0.5)
    assert {"read", "gain", "saturation", "nodata"} == {field.name for field in dataclasses.fields(jaxhf.Noise)}
    assert jaxhf.Noise(**first).saturation == 2


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
    seen = np.arange(12, dtype=np.uint8).reshape(3, 4)
    geotiffs.write(folder / "seen.tif", seen, nodata=0)
    geotiffs.write(folder / "mask.tif", np.where(seen < 6, 255, 1).astype(np.uint8), nodata=255)
    alone = case(folder, SCENE + '[[pictures]]\nimage = "seen.tif"\ntransfer = "linear"\n')
    np.testing.assert_allclose(alone.targets[0][..., 0], np.where(seen == 0, np.nan, seen / 255), rtol=1e-6)
    np.testing.assert_array_equal(alone.weights[0], seen > 0)
    np.testing.assert_array_equal(case(folder, WHOLE + 'mask = "mask.tif"\n').weights[0], seen >= 6)
    both = case(folder, SCENE + '[[pictures]]\nimage = "seen.tif"\nweights = "weights.npy"\n')
    np.testing.assert_array_equal(both.weights[0], np.arange(12).reshape(3, 4) / 4 * (seen > 0))


@pytest.mark.parametrize("ending", ["toml", "pbrt"])
def test_a_scene_may_lie_in_a_file_of_its_own(folder, ending):
    """Its camera's size becomes that of the picture, which has its proportions."""
    pbrt = (
        'LookAt 0.5 0.5 3  0.5 0.5 0  0 1 0 Camera "perspective" "float fov" [45]\n'
        'Film "image" "integer xresolution" [40] "integer yresolution" [30] WorldBegin LightSource "distant"\n'
        'Shape "heightfield" "integer nu" [3] "integer nv" [3] "float Pz" [0 1 2 3 4 5 6 7 9] WorldEnd'
    )
    sized = SCENE.replace("up =", "width = 40\nheight = 30\nup =")
    (folder / f"scene.{ending}").write_text(pbrt if ending == "pbrt" else sized)
    found = case(folder, f'scene = "scene.{ending}"\n{PICTURE}')
    assert (found.scenes[0].camera.width, found.scenes[0].camera.height) == (4, 3)
    assert found.scenes[0].heights[2, 2] == 9
    assert len(found.scenes[0].lights) == 1


def test_the_map_of_a_geotiff_is_kept_unless_the_scene_puts_it_elsewhere(folder):
    """What else is not given is left to `fit`."""
    pytest.importorskip("rasterio")
    jaxhf.save_heights(folder / "dem.tif", jaxhf.Terrain(np.ones((3, 3))))
    field = 'shape = "heightfield"\nfile = "dem.tif"\n'
    scene = SCENE[: SCENE.index("shape")]
    assert case(folder, scene + field + PICTURE).like == folder / "dem.tif"
    found = case(folder, scene + field + "x0 = 3\n" + PICTURE)
    kept = found.like, found.options, found.prior, found.unknown, found.weights, found.noise, found.settings
    assert kept == (None, {}, {}, {}, (None,), None, jaxhf.Settings())


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
    return field + PICTURE + f'\n[fit]\nstart = "{prior}"\n[fit.prior]\nheights = "{prior}"\nstd = "{prior}"\n'


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
    given = case(folder, with_prior(ending, prior))
    found = given.prior["heights"]
    if name == "coarse":
        np.testing.assert_allclose(found[1:3, 1:4], expected[1:3, 1:4], rtol=1e-12)
        np.testing.assert_array_equal(found[[0, 0, -1, -1], [0, -1, 0, -1]], held.ravel())
    else:
        shift = 360 * (name == "degrees from 0 on")
        np.testing.assert_allclose(found, expected + shift, rtol=1e-12)
    for other in (given.options["start"], given.prior["std"]):
        np.testing.assert_array_equal(other, found)
    # A terrain that is moved and scaled in the scene is still its own.
    own = case(folder, with_prior(ending, ending, "dx = 9.0\ndy = 6.0\nx0 = 0\ny0 = 0\n")).prior["heights"]
    np.testing.assert_array_equal(own, expected)
    # Without a place, or over a terrain without one, it is left to `fit`.
    np.save(folder / "bare.npy", held)
    assert case(folder, with_prior(ending, "bare.npy")).prior["heights"].shape == shape
    np.save(folder / "tile.npy", expected)
    assert case(folder, with_prior("tile.npy", prior)).prior["heights"].shape == shape
    placed = "dx = {}\ndy = {}\nx0 = {}\ny0 = {}\n".format(*tile)
    if "degrees" in name:
        said = r":22: fit\.start: it must lie in the coordinates of the terrain, .* degrees"
        with pytest.raises(jaxhf.SceneError, match=said):
            case(folder, with_prior("tile.npy", prior, placed))
    else:
        np.testing.assert_array_equal(case(folder, with_prior("tile.npy", prior, placed)).prior["heights"], found)


def refused(folder, text, *messages):
    """What is wrong with a prior is said of the start, which stands in line 18."""
    with pytest.raises(jaxhf.SceneError, match=r":18: fit\.start: it must ") as error:
        case(folder, text)
    assert all(message in str(error.value) for message in messages)


def test_a_prior_covers_the_terrain(folder):
    terrain_file(folder / "tile.npz", TILE, (4, 5))
    for x0, y0, axis, whole, own in (
        (500016.0, 4100000.0, "x", "500000 to 500120", "500016 to 500136"),
        (500000.0, 4100011.0, "y", "4100000 to 4100060", "4100011 to 4100071"),
    ):
        terrain_file(folder / "off.npz", (30.0, 20.0, x0, y0), (4, 5))
        said = f"cover the terrain, whose {axis} goes from {whole}; its own goes from {own}"
        refused(folder, with_prior("tile.npz", "off.npz"), said)
    with pytest.raises(ValueError, match=r"it must have the terrain's coordinates, EPSG:32617; it has EPSG:32616"):
        at_vertices(*(jaxhf.Terrain(np.zeros((2, 2)), *TILE, CoordinateSystem(code=code)) for code in (32616, 32617)))


def test_a_hole_in_a_prior_is_an_error_where_the_terrain_is(folder):
    """By its scale and nodata, which are the terrain's unless its file has its own."""
    terrain_file(folder / "tile.npz", TILE, (4, 5))
    region = (30.0, 20.0, 499970.0, 4099980.0)
    border = [(0, k) for k in range(7)] + [(k, 6) for k in range(6)]
    whole = terrain_file(folder / "region.npz", region, (6, 7), holes=border)
    np.testing.assert_allclose(case(folder, with_prior("tile.npz", "region.npz")).prior["heights"], whole[1:5, 1:6])
    terrain_file(folder / "region.npz", region, (6, 7), holes=[*border, (2, 3)])
    refused(folder, with_prior("tile.npz", "region.npz"), "1 of 20 are holes; the first is row 1 column 2")
    bare = np.array([[1.0, 2], [3, 4]], np.float32)
    np.save(folder / "bare.npy", bare)
    found = case(folder, with_prior("tile.npz", "bare.npy", "z_scale = -2\n")).prior
    np.testing.assert_array_equal(found["heights"], -2 * bare)
    np.testing.assert_array_equal(found["std"], 2 * bare)
    with pytest.raises(jaxhf.SceneError, match="1 of 4 are holes; the first is row 1 column 0"):
        case(folder, with_prior("tile.npz", "bare.npy", "nodata = 3\n"))
    Image.fromarray(bare).save(folder / "own.tif", tiffinfo={42113: "1"})
    with pytest.raises(jaxhf.SceneError, match="1 of 4 are holes; the first is row 1 column 0"):  # the north's 1, not the 3
        case(folder, with_prior("tile.npz", "own.tif", "nodata = 3\n"))


of_picture = f"{WHOLE}{{}}\n".format
of_fit = f"{WHOLE}\n[fit]\n{{}}\n".format
SIZED = WHOLE.replace("up =", "width = 50\nheight = 30\nup =")
# The text, the line of the mistake (None: no line), and what the message says.
BAD = [
    (WHOLE + "\n[fits]\n", 17, "unknown key 'fits'; did you mean 'fit'"),
    (of_fit("max_step = 3"), 18, "unknown key 'max_step' in fit; did you mean 'max_steps'"),
    (of_picture('[[pictures.lights]]\ntype = "sky"\nradience = 1'), 18, "unknown key 'radience' in pictures[0].lights[0]"),
    (WHOLE + "\n[settings]\nsamples = 3\n", 18, "settings.samples must be a square number"),
    (WHOLE + "\n[settings]\nshadows = 1\n", 18, "settings.shadows must be true or false, it is 1"),
    (SCENE, None, "a fit must have 'pictures', those that were measured; this is a scene"),
    (WHOLE.replace("grey", "../grey"), 15, "pictures[0].image: '../grey.npy' lies outside"),
    (PICTURE, None, "a fit must have 'scene', "),
    ('scene = "x.toml"\n' + WHOLE, 2, "camera must stand without scene"),
    (WHOLE[WHOLE.index("[[lights]]") :], 8, "pictures[0] must have a camera"),
    (of_picture('mask = "mask.png"\nweights = "grey.npy"'), 17, "pictures[0] must have mask or weights, it has both"),
    (of_picture('mask = "prior.npy"'), 16, "pictures[0].mask must have the size of the image, 4 x 3 pixels; it is 3 x 3"),
    (SIZED, 17, "pictures[0].image must have the proportions of its camera, 50 x 30 pixels; it is 4 x 3 pixels"),
    (of_picture("noise = 0"), 16, "pictures[0].noise must be positive or a table, it is 0"),
    (of_picture("noise = { read = 0 }"), 16, "pictures[0].noise.read must be positive, it is 0"),
    (of_fit("[fit.noise]\nread = 1\ngain = -1"), 20, "fit.noise.gain must be from 0 on, it is -1"),
    (of_fit("noise = { gain = 1 }"), 18, "fit.noise must have 'read', it is missing"),
    (of_fit('prior = { heights = 0, std = "colour.npy" }'), 18, "colour.npy: heights must have shape (ny, nx)"),
    (of_fit("prior = { heights = 0 }"), 18, "fit.prior must have 'std', it is missing"),
    (of_fit("prior_std = 1"), 18, "unknown key 'prior_std' in fit; did you mean 'prior'"),
]


@pytest.mark.parametrize(("text", "line", "message"), BAD, ids=[message for *_, message in BAD])
def test_mistakes_are_named_with_their_line(folder, text, line, message):
    with pytest.raises(jaxhf.SceneError, match=re.escape(message)) as error:
        case(folder, text)
    assert str(error.value).startswith(f"{folder}/case.toml:{f'{line}:' if line else ''} ")


# What `fit` refuses, and not the reader: an option, its argument, an image, a mask.
LOCATED = [
    (of_fit("max_steps = 0"), ":18: fit.max_steps must be a whole number from 1 on, it is 0"),
    (of_fit("[fit.prior]\nheights = 0\nstd = 0"), ":20: fit.prior.std must be finite, from 0 on, not all 0; it is 0"),
    (of_fit("unknown.camera_std = [7, 1]"), ":18: fit.unknown.camera_std must have a position that is off by at most"),
    (WHOLE.replace("grey", "nan"), ":15: pictures[0].image must be finite where "),
    (of_picture('mask = "nothing.npy"'), ":16: pictures[0].mask must be finite, from 0 on, not all 0"),
]


@pytest.mark.parametrize(("text", "message"), LOCATED, ids=[message for _, message in LOCATED])
def test_what_fit_refuses_is_named_with_its_line(folder, text, message):
    np.save(folder / "nan.npy", np.array([[0.0, np.nan, 1.0], [0.0, 0.0, 1.0]]))
    np.save(folder / "nothing.npy", np.zeros((3, 4)))
    given = case(folder, text)
    with pytest.raises(jaxhf.ArgumentError) as refused:
        jaxhf.fit(
            given.scenes, given.targets, weights=given.weights, noise=given.noise, unknown=jaxhf.Unknown(**given.unknown),
            prior=jaxhf.Prior(**given.prior) if given.prior else None, **given.options,
        )  # fmt: skip
    assert str(given.located(refused.value)).startswith(f"{folder}/case.toml{message}")


def test_what_fit_refuses_though_no_file_says_it(folder):
    error = case(folder, WHOLE).located(jaxhf.ArgumentError("fit", "max_steps", "must be more"))
    assert str(error) == f"{folder}/case.toml: fit.max_steps must be more"


@pytest.mark.parametrize("name", ["prior.npy", "prior.npz", "half.npy"])
def test_a_prior_goes_with_the_terrain_into_its_surroundings(folder, name):
    """Over the footprint of the terrain as it is given, whatever of it is left there; a file that says where it lies may."""
    random, (y, x) = np.random.default_rng(0), np.indices((35, 40))
    plane = (y + 3.0 * x).astype(np.float32)
    jaxhf.save_heights(folder / "fine.npz", jaxhf.Terrain(random.random((35, 40), np.float32), 1.0, 1.0, 70.0, 60.0))
    jaxhf.save_heights(folder / "coarse.npz", jaxhf.Terrain(random.random((20, 20), np.float32), 8.0, 8.0))
    jaxhf.save_heights(
        folder / "prior.npz", jaxhf.Terrain(np.pad(plane, 5, "reflect", reflect_type="odd"), 1.0, 1.0, 65.0, 55.0)
    )
    np.save(folder / "prior.npy", plane)
    np.save(folder / "half.npy", plane[::2, ::3])
    terrain = 'file = "fine.npz"\n[[objects]]\nshape = "heightfield"\nfile = "coarse.npz"\naround = true'
    heights = "heights = [[0, 1, 2], [3, 4, 5], [6, 7, 9]]"
    known = f'[fit]\nprior = {{ heights = "{name}", std = 1 }}\n'
    found = case(folder, SCENE.replace(heights, terrain) + PICTURE + known)
    field = found.scenes[0].heightfields[0]
    ny, nx = field.heights.shape
    y, x = field.y0 - 60 + np.arange(ny), field.x0 - 70 + np.arange(nx)
    assert (ny, nx) == (27, 35)  # three and four coarse cells, and the ring
    expected = y.clip(0, 34)[:, None] + 3 * x.clip(0, 39)
    np.testing.assert_allclose(found.prior["heights"], expected, atol=1e-4)
