"""Cameras of pictures that know their place on the globe: of RPC models as GDAL's transformer has them, of orthophotos."""

import copy
import dataclasses
import re

import geotiffs
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
from jaxhf.io.terrain.georeference import WGS84, WGS84_DEGREES, CoordinateSystem, Georeference
from jaxhf.scene.procedural import fractal

rasterio = pytest.importorskip("rasterio")
warp = pytest.importorskip("rasterio.warp")
RPC = pytest.importorskip("rasterio.rpc").RPC
RPCTransformer = pytest.importorskip("rasterio.transform").RPCTransformer


def coefficients(text: str) -> list[float]:
    return [float(word) for word in text.split()]


# Pixels of 7 m seen at 50 degrees from the vertical: the metadata of rasterio's tests/data/RGB.byte.rpc.vrt.
COAST = RPC(
    height_off=89, height_scale=701, lat_off=49.2199, lat_scale=0.3093, long_off=-123.176, long_scale=0.4534,
    line_off=5760, line_scale=5761, samp_off=3724, samp_scale=3725,
    line_num_coeff=coefficients("""
        2.001303029283497e-03 -1.860717345625879e-01 -1.127856422682348e+00 -4.632230551975493e-05 1.019881908582774e-03
        5.673855447822687e-08 -8.698433522294479e-08 -3.226759855088540e-03 -1.332756784778704e-03 0
        1.215249975522747e-08 -7.132377372126199e-07 2.017197679474549e-06 8.275158167048898e-08 -1.210585983708413e-06
        -1.078353887170730e-06 5.032973521799926e-07 0 1.716128319528072e-08 0"""),
    line_den_coeff=coefficients("""
        1 9.222511757408093e-04 9.437608823165506e-04 0 3.227813186168402e-07 0 -1.209023819818124e-08
        1.847595567040099e-06 5.799102000140301e-07 -4.460833665210641e-07 0 0 -6.034797295293836e-08 0
        1.667569505660956e-07 -2.974442475526043e-08 0 0 0 0"""),
    samp_num_coeff=coefficients("""
        2.202618393703774e-02 1.185886131197477e+00 -2.151710781539888e-01 3.045218075295352e-02 2.420581655336635e-03
        -4.398438360671764e-06 5.871407208028941e-05 -2.166676957828599e-02 -4.180699044156175e-04 -2.753492566174621e-05
        -7.124639699900795e-06 -1.101195320211651e-05 -1.119110912711932e-04 -1.096184653732520e-04 1.183590823839227e-04
        1.382552349641905e-05 1.997075688106731e-05 2.673528192748438e-05 -1.230207121465409e-06 -2.830467933081173e-06"""),
    samp_den_coeff=coefficients("""
        1 9.278262976396983e-05 1.781926782031641e-03 -6.510570023623242e-04 -2.216055849873611e-04 9.161290674286373e-07
        3.126587074446549e-06 3.565361629769621e-04 -2.582447705973245e-05 -9.228544337667984e-05 5.298085166219470e-07
        1.025006482963347e-05 7.478466127324454e-07 -1.692384939549647e-06 -1.124443674146492e-05 -1.793428625616464e-07
        -2.791740249303018e-07 -2.820306656137878e-07 4.593502012060843e-08 1.035174961061441e-07"""),
)  # fmt: skip
# Pixels of 0.57 m seen at 30 degrees from the vertical: the demonstration in geowatch's gis/spatial_reference.py.
SHARP = RPC(
    height_off=134, height_scale=501, lat_off=37.7574, lat_scale=0.063, long_off=128.9868, long_scale=0.1238,
    line_off=10679, line_scale=10680, samp_off=17589, samp_scale=17590,
    line_num_coeff=coefficients("""
        0.005421624 0.1940749 -1.211795 0.01633917 -0.0004186136 2.647701e-05 -4.734004e-05 -0.001422265 -0.003701303
        6.023497e-08 4.668106e-07 -4.195505e-06 -2.337797e-05 -4.190499e-06 1.710599e-05 7.084406e-05 2.61384e-05
        -4.056353e-07 -1.79412e-06 -3.535734e-07"""),
    line_den_coeff=coefficients("""
        1 -0.001280647 0.002106012 -0.0001507726 -3.584366e-05 0 -3.407159e-06 -1.13468e-05 8.050045e-05 -2.154705e-05
        3.680717e-06 -1.18494e-06 -0.0001362055 2.194475e-08 2.225298e-05 0.0002853284 1.715958e-07 -2.953517e-07
        -1.154067e-05 0"""),
    samp_num_coeff=coefficients("""
        -0.00757565 1.026796 0.0007400306 -0.0254972 -0.000593794 0.0001250929 -6.722757e-05 0.007166261 6.205097e-05
        -4.390415e-06 -1.18329e-06 4.165168e-05 2.937798e-05 -3.408414e-07 -1.045831e-05 -0.0001462765 -1.455117e-07
        2.673684e-06 6.849923e-06 1.029223e-08"""),
    samp_den_coeff=coefficients("""
        1 0.0004235249 0.0006144441 -0.0003215715 -4.071902e-08 -2.171622e-06 1.747825e-06 9.980383e-06 -3.155285e-05
        -4.147756e-07 -1.752229e-08 -1.628482e-07 5.040285e-07 0 -1.813282e-07 7.100189e-07 0 -3.722191e-08
        1.117271e-08 0"""),
)  # fmt: skip
WHOLE = {"width": 7450, "height": 11522}  # COAST's picture
N = 65


def file_of(path, rpcs, side: float, relief: float, crs: str = "EPSG:32610"):
    """Hills of single precision around the middle of a model's terrain; `side` is in the units of the reference system."""
    (x,), (y,) = warp.transform("EPSG:4326", crs, [rpcs.long_off], [rpcs.lat_off])
    step = side / (N - 1)
    heights = (100 + relief * fractal([N, N], seed=3, exponent=2.2)).astype(np.float32)
    return geotiffs.write(path, heights[::-1], (step, 0, x - side / 2 - step / 2, 0, -step, y + side / 2 + step / 2), crs)


def mapped(transform, column: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a, b, c, d, e, f, *_ = transform
    return a * column + b * row + c, d * column + e * row + f


def on_surface(path, terrain) -> tuple[np.ndarray, np.ndarray]:
    """1e4 points on cells' diagonals: in the world, and by GDAL as longitude, latitude and height."""
    rng = np.random.default_rng(0)
    (ix, iy), t = rng.integers(0, N - 1, (2, 10000)), rng.uniform(size=10000)
    z = terrain.heights.astype(np.float64)
    z = z[iy, ix] + t * (z[iy + 1, ix + 1] - z[iy, ix])
    with rasterio.open(path) as file:
        place = warp.transform(file.crs, "EPSG:4326", *mapped(file.transform, ix + t + 0.5, N - 1 - iy - t + 0.5))
    world = [terrain.x0 + (ix + t) * terrain.dx, terrain.y0 + (iy + t) * terrain.dy, z]
    return np.stack(world, axis=1), np.stack([*place, z], axis=1)


def by_gdal(rpcs, place: np.ndarray) -> np.ndarray:
    """Pixels, the top left corner at (0, 0), where gdaltransform -i -rpc has them, too."""
    with RPCTransformer(rpcs) as model:
        rows, columns = model.rowcol(*place.T, op=np.positive)
    return np.stack([columns, rows], axis=1)


@pytest.mark.parametrize(
    ("rpcs", "side", "relief", "crs"),
    [
        (COAST, 1700, 50, "EPSG:32610"),
        (COAST, 1600, 0, "EPSG:32610"),
        (COAST, 0.018, 400, "EPSG:4326"),
        (SHARP, 500, 50, "EPSG:32652"),
        (SHARP, 350, 300, "EPSG:32652"),
    ],
)
def test_a_terrain_is_seen_where_gdal_has_it(tmp_path, rpcs, side, relief, crs):
    """To 0.05 pixels, at 1e4 points of it; the camera stands hundreds of kilometres away."""
    terrain = jaxhf.load_heights(path := file_of(tmp_path / "a.tif", rpcs, side, relief, crs))
    camera = jaxhf.Perspective.from_rpc(rpcs, terrain, width=40000, height=40000)
    world, place = on_surface(path, terrain)
    off = np.linalg.norm(camera.project(world) - by_gdal(rpcs, place), axis=1)
    assert 0.001 < off.max() < 0.05
    assert np.linalg.norm(np.asarray(camera.world_from_camera)[:3, 3] - world.mean(axis=0)) > 5e5
    high = jaxhf.Perspective.from_rpc(rpcs, terrain, width=40000, height=40000, geoid=30.0)
    off = np.linalg.norm(high.project(world) - by_gdal(rpcs, place + np.array([0, 0, 30])), axis=1)
    assert off.max() < 0.05


@pytest.mark.deep  # of the figures in docs/guides/cameras.md
@pytest.mark.parametrize(
    ("rpcs", "crs", "alone", "left"), [(COAST, "EPSG:32610", 0.35, 0.007), (SHARP, "EPSG:32652", 3.9, 0.04)]
)
def test_how_far_a_scanner_is_from_a_pinhole(tmp_path, rpcs, crs, alone, left):
    """Over 5 km; and how much of that two heights 10 m apart differ in, which are seen at the same pixel."""
    terrain = jaxhf.load_heights(path := file_of(tmp_path / "a.tif", rpcs, 5e3, 500, crs))
    camera = jaxhf.Perspective.from_rpc(rpcs, terrain, width=40000, height=40000, max_error=9.0)
    world, place = on_surface(path, terrain)
    off = camera.project(world) - by_gdal(rpcs, place)
    assert alone * 0.8 < np.linalg.norm(off, axis=1).max() < alone * 1.2
    ray = world - np.asarray(camera.world_from_camera)[:3, 3]
    higher = world + ray * (10 / ray[:, 2:])
    latitude, longitude, z = terrain.geodetic(*higher.T)
    change = camera.project(higher) - by_gdal(rpcs, np.stack([longitude, latitude, z], axis=1)) - off
    assert left * 0.8 < np.linalg.norm(change, axis=1).max() < left * 1.2


@pytest.mark.deep  # test_resection.py has a picture from 700 km
def test_a_picture_shows_what_the_model_sees(tmp_path):
    """A window of it, in single precision; what each pixel shows is where GDAL has the pixel's middle."""
    whole = jaxhf.load_heights(path := file_of(tmp_path / "a.tif", SHARP, 5e3, 900, "EPSG:32652"))
    _, place = on_surface(path, whole)
    column, row = np.round(by_gdal(SHARP, place).mean(axis=0))
    rpcs = copy.copy(SHARP)
    rpcs.samp_off -= column
    rpcs.line_off -= row
    camera = jaxhf.Perspective.from_rpc(rpcs, whole, width=160, height=120)
    scene = jaxhf.Scene([jaxhf.Object(whole.heightfield())], camera)
    _, aovs = jaxhf.render(scene, jaxhf.Settings(shading="flat"), aovs=("status", "depth"))
    assert (np.asarray(aovs["status"]) == jaxhf.Status.HIT).all()
    middles = np.stack(np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5), axis=-1)
    hits = (
        np.asarray(camera.world_from_camera)[:3, 3] + directions(camera, middles) * np.asarray(aovs["depth"], float)[..., None]
    )
    latitude, longitude, above = whole.geodetic(*np.moveaxis(hits, -1, 0))
    seen = by_gdal(rpcs, np.stack([longitude, latitude, above], axis=-1).reshape(-1, 3))
    assert np.abs(seen - middles.reshape(-1, 2)).max() < 0.05


def directions(camera, pixels: np.ndarray) -> np.ndarray:
    """Unit vectors through pixels, in double precision."""
    matrix, half = np.asarray(camera.world_from_camera), np.tan(np.radians(float(camera.fov)) / 2)
    short, size = min(camera.width, camera.height), np.array([camera.width, camera.height])
    x, y = np.moveaxis((2 * pixels - size) / short * half, -1, 0)
    d = np.stack([x, -y, np.ones_like(x)], axis=-1) @ matrix[:3, :3].T
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def test_models_are_read_from_files_and_feet_are_metres(tmp_path):
    """A dataset's own; z in feet is told by the file, and x and y by the system."""
    path = file_of(tmp_path / "a.tif", COAST, 1000, 50)
    picture = geotiffs.write(tmp_path / "b.tif", np.zeros((4, 4), np.uint8), (1, 0, 0, 0, 1, 7), None, {"rpcs": COAST})
    with rasterio.open(picture) as file:
        rpcs = file.rpcs
    terrain = jaxhf.load_heights(path)
    camera = jaxhf.Perspective.from_rpc(rpcs, terrain, **WHOLE)
    world, _ = on_surface(path, terrain)
    np.testing.assert_allclose(
        camera.project(world), jaxhf.Perspective.from_rpc(COAST, terrain, **WHOLE).project(world), atol=1e-6
    )
    assert terrain.georeference is not None
    feet = dataclasses.replace(terrain, georeference=terrain.georeference._replace(z_unit="US survey foot"))
    np.testing.assert_allclose(feet.geodetic(0, 0, [100.0])[2], [30.48])
    np.testing.assert_allclose(terrain.geodetic(0, 0, [100.0])[2], [100])


def test_the_moon_has_its_own_longitudes(tmp_path):
    """Of an equirectangular map: x is radius times longitude."""
    crs = "+proj=eqc +R=1737400 +units=m +no_defs"
    path = geotiffs.write(tmp_path / "moon.tif", np.zeros((3, 3), np.float32), (100, 0, 3e5, 0, -100, 2e5), crs)
    latitude, longitude, _ = jaxhf.load_heights(path).geodetic([3e5, 4e5], 2e5, 0)
    np.testing.assert_allclose(longitude, np.degrees(np.array([3e5, 4e5]) / 1737400), rtol=1e-9)
    np.testing.assert_allclose(latitude, np.degrees(2e5 / 1737400), rtol=1e-9)


@pytest.mark.parametrize(
    ("crs", "x", "y"), [("EPSG:32632", 7.2e5, 5.2e6), ("EPSG:32632", 3e5, 5.2e6), ("EPSG:32732", 7.2e5, 5e6)]
)
def test_a_maps_north_is_told_from_the_true_one(tmp_path, crs, x, y):
    """By tan(convergence) = tan(longitude from the zone's middle) sin(latitude), on the ellipsoid less than 0.1 % off."""
    terrain = jaxhf.load_heights(geotiffs.write(tmp_path / "a.tif", np.zeros((9, 9), np.float32), (30, 0, x, 0, -30, y), crs))
    latitude, longitude = np.radians(terrain.place)
    expected = np.degrees(np.arctan(np.tan(longitude - np.radians(9)) * np.sin(latitude)))
    np.testing.assert_allclose(terrain.convergence, expected, rtol=1e-3)
    assert abs(expected) > 1.5
    degrees = jaxhf.Terrain(np.zeros((3, 3)), 1e-3, 1e-3, 8.0, 46.0, CoordinateSystem(True, WGS84), Georeference(WGS84_DEGREES))
    assert abs(degrees.in_metres().convergence) < 1e-9
    assert np.isnan(jaxhf.Terrain(np.zeros((3, 3))).convergence)


def test_what_no_perspective_sees_is_refused(tmp_path, as_users_call_it):
    terrain = jaxhf.load_heights(file_of(tmp_path / "a.tif", COAST, 5000, 50))
    bare, holes = dataclasses.replace(terrain, georeference=None), terrain.heights * np.nan
    for rpcs, ground, more, message in (
        (COAST, terrain, {}, "terrain must be small enough for one perspective; a part of it, or of the picture, is seen more "
         "nearly so (pixels must lie within max_error = 0.05 pixels of where one camera sees the points; "),
        (COAST, terrain, {"width": 99, "height": 99}, "terrain must be in the picture of 99 x 99 pixels, it is at columns 3"),
        (COAST, bare, {}, "terrain must have a place on a globe, its georeference does not say it"),
        (COAST, dataclasses.replace(terrain, heights=holes), {}, "terrain must have heights, nan being none; they go from nan"),
        (COAST, terrain.heights, {}, "terrain must be a Terrain, as load_heights gives it, it is a ndarray"),
        (None, terrain, {}, "rpcs must be an RPC of rasterio's, as dataset.rpcs, it is None"),
        (COAST, terrain, {"geoid": np.nan}, "geoid must be finite, it is nan"),
        (COAST, terrain, {"max_error": -1}, "max_error must be positive and finite, it is -1"),
        (COAST, terrain, {"width": 2.5}, "width must be a whole number of pixels from 1 on, it is 2.5"),
    ):  # fmt: skip
        with pytest.raises(jaxhf.ArgumentError, match=f"^from_rpc: {re.escape(message)}"):
            jaxhf.Perspective.from_rpc(rpcs, ground, **{**WHOLE, **more})
    assert jaxhf.Perspective.from_rpc(COAST, terrain, **WHOLE, max_error=0.5).width == WHOLE["width"]


PLACES = {  # what rasterio's Affine begins with
    "north up": (2.0, 0, 5e5 - 3.3, 0, -2.0, 4.1e6 + 1.2),
    "narrow pixels": (2.0, 0, 5e5 - 3.3, 0, -3.5, 4.1e6 + 1.2),
    "turned": (1.6, 1.1, 5e5 - 20.3, 0.9, -1.7, 4.1e6 + 0.2),
    "south up": (2.0, 0, 5e5 - 3.3, 0, 2.0, 4.1e6 - 20.2),
}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("degrees", [False, True])
def test_an_orthophoto_shows_what_its_geotransform_says(tmp_path, place, degrees):
    """Each pixel's middle; of a terrain in degrees, too, which is in metres from its corner."""
    per = 1e-5 if degrees else 1.0
    numbers = np.array(PLACES[place])
    if degrees:
        numbers = (numbers - [0, 0, 5e5, 0, 0, 4.1e6]) * per + [0, 0, 8.5, 0, 0, 46.5]
    corner = (8.5, 46.5) if degrees else (5e5, 4.1e6)
    heights = np.random.default_rng(1).uniform(0, 3, (30, 40)).astype(np.float32)
    grid = (3 * per, 0, corner[0] - 30 * per, 0, -3 * per, corner[1] + 20 * per)
    path = geotiffs.write(tmp_path / "a.tif", heights, grid, "EPSG:4326" if degrees else "EPSG:32632")
    terrain, transform = jaxhf.load_heights(path), rasterio.Affine(*numbers)
    for width, height in ((24, 20), (20, 24)):
        camera = jaxhf.Orthographic.from_geotransform(transform, terrain, width=width, height=height)
        scene = jaxhf.Scene([jaxhf.Object(terrain.heightfield())], camera)
        _, aovs = jaxhf.render(scene, jaxhf.Settings(shading="flat"), aovs=("status", "uv"))
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        x, y = mapped(transform, columns, rows)
        u = ((x - grid[2]) / grid[0] - 0.5) / 39
        v = ((y - grid[5]) / -grid[4] + 29.5) / 29
        met = np.asarray(aovs["status"]) == jaxhf.Status.HIT
        np.testing.assert_array_equal(met, (u > 0) & (u < 1) & (v > 0) & (v < 1))
        np.testing.assert_allclose(np.asarray(aovs["uv"])[met], np.stack([u, v], axis=-1)[met], atol=2e-6)
        assert met.mean() > 0.3
        assert np.asarray(camera.world_from_camera)[2, 3] > 2 * heights.max()
        if not degrees:
            side = np.linalg.norm(numbers[[0, 3]]) * width if width < height else np.linalg.norm(numbers[[1, 4]]) * height
            np.testing.assert_allclose(camera.extent, side)


def test_what_is_no_geotransform_is_refused(tmp_path):
    terrain = jaxhf.Terrain(np.eye(3, dtype=np.float32))
    Affine = rasterio.Affine
    for transform, ground, message in (
        ((0, 1, 0, 3, 0, -1), terrain, "transform must be an Affine, as rasterio's dataset.transform or Affine.from_gdal"),
        (Affine(1, 1, 0, 1, 1, 0), terrain, "transform must be finite and invertible, it is [[1.0, 1.0, 0.0], [1.0, 1.0, 0.0"),
        (Affine(1, 0, np.nan, 0, -1, 0), terrain, "transform must be finite and invertible, it is [[1.0, 0.0, nan], ["),
        (Affine(1, 0, 0, 0, -1, 2.5), terrain.heights, "terrain must be a Terrain, as load_heights gives it, it is a ndarray"),
    ):
        with pytest.raises(jaxhf.ArgumentError, match=f"^from_geotransform: {re.escape(message)}"):
            jaxhf.Orthographic.from_geotransform(transform, ground, width=3, height=3)
    camera = jaxhf.Orthographic.from_geotransform(Affine(1, 0, 0, 0, -1, 2.5), terrain, width=3, height=3)
    ray = camera.ray(jnp.float32(0.5), jnp.float32(2.0))
    np.testing.assert_allclose(ray.o, [0.5, 0.5, 5])
    np.testing.assert_allclose(ray.d, [0, 0, -1])
