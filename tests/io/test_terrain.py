"""Heights end up where the file says, with the north up."""

import io
import re
import struct
import sys
import zipfile

import geotiffs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from alike import placed
from PIL import Image
from test_images import png, raw

from jaxhf import Terrain, jacksboro, load_heights, load_image, save_heights, save_image, save_mesh
from jaxhf.io.files import MAX_PIXELS

# What a file with the north first holds: two rows, the northern one 1 2 3.
NORTH_FIRST = np.array([[1, 2, 3], [4, 5, 6]], np.uint16)
SOUTH_FIRST = NORTH_FIRST[::-1]


def write_degrees(path, keys):
    """A GeoTIFF by hand, 60 degrees north, with GeoKeys that rasterio does not write; floats stand in tag 34736."""
    keys = {1024: 2, 1025: 1, **keys}  # geographic, of pixels that are areas
    doubles = tuple(value for value in keys.values() if isinstance(value, float))
    directory = (1, 1, 0, len(keys))
    for key, value in sorted(keys.items()):
        directory += (key, 34736, 1, doubles.index(value)) if isinstance(value, float) else (key, 0, 1, value)
    tags = {33550: (0.01, 0.01, 0.0), 33922: (0.0, 0.0, 0.0, 10.0, 60.01, 0.0), 34735: directory, 34736: doubles or (0.0,)}
    Image.fromarray(NORTH_FIRST).save(path, tiffinfo=tags)


MOON, MARS = 1737400.0, 3396190.0


def ellipse_at_60(a, c):
    """By the parametric latitude b: the parallel's radius a cos(b), and the meridian's radius of curvature."""
    b = np.arctan(c / a * np.tan(np.radians(60)))
    return a * np.cos(b), ((a * np.sin(b)) ** 2 + (c * np.cos(b)) ** 2) ** 1.5 / (a * c)


EARTH_AT_60 = ellipse_at_60(6378137.0, 6356752.314245)


@pytest.mark.parametrize(
    ("keys", "along_x", "along_y"),
    [
        # A sphere's radius r: r cos(60) and r to a radian.
        ({2048: 32767, 2057: MOON, 2058: MOON}, MOON / 2, MOON),
        ({2048: 32767, 2057: MOON, 2059: 0.0}, MOON / 2, MOON),
        ({2048: 49900, 2057: MARS, 2058: 3376200.0}, *ellipse_at_60(MARS, 3376200.0)),
        # The Earth's system in full, and those without axes.
        ({2048: 4326}, *EARTH_AT_60),
        ({2048: 4269}, *EARTH_AT_60),
        ({2048: 32767, 2056: 7030}, *EARTH_AT_60),
        ({2048: 32767, 2057: MOON}, MOON / 2, MOON),
    ],
)
def test_degrees_are_those_of_the_files_globe(tmp_path, keys, along_x, along_y):
    write_degrees(tmp_path / "x.tif", keys)
    terrain = load_heights(tmp_path / "x.tif")
    np.testing.assert_allclose((terrain.dx, terrain.dy), np.radians(0.01) * np.array((along_x, along_y)), rtol=1e-7)
    assert placed(terrain)[2:] == (0, 0)


def test_a_globe_of_unknown_size_needs_a_cell_size(tmp_path):
    for keys in ({2048: 32767}, {2048: 30100}, {}):
        write_degrees(tmp_path / "x.tif", keys)
        with pytest.raises(ValueError, match=r"x\.tif: its degrees are on a globe of unknown size: dx and dy must be given"):
            load_heights(tmp_path / "x.tif", dx=3.0)
        assert placed(load_heights(tmp_path / "x.tif", dx=3.0, dy=4.0)) == (3, 4, 0, 0)


HOLES = [
    ("-9999", np.float32, -9999.0, {}),
    ("-3.4028235e+38", np.float32, np.finfo(np.float32).min, {}),
    ("65535", np.uint16, 65535, {}),
    ("-9999", np.uint16, None, {}),  # a tag whose value the type cannot hold
    (None, np.uint16, 7, {"nodata": 7.0}),
    ("65535", np.uint16, 0, {"nodata": 0.0}),  # the argument overrules the tag
    (None, np.float32, np.nan, {}),
    (None, np.float32, np.inf, {}),
]


@pytest.mark.parametrize(("tag", "dtype", "hole", "arguments"), HOLES)
def test_what_means_no_data_is_a_hole(tmp_path, tag, dtype, hole, arguments):
    stored = NORTH_FIRST.astype(dtype)
    expected = stored.astype(np.float32) * 2
    if hole is not None:
        stored[0, 1], expected[0, 1] = hole, np.nan
    Image.fromarray(stored).save(tmp_path / "x.tif", tiffinfo={} if tag is None else {42113: tag})
    terrain = load_heights(tmp_path / "x.tif", z_scale=2.0, **arguments)
    np.testing.assert_array_equal(terrain.heights, expected[::-1])
    np.testing.assert_array_equal(terrain.nodata, np.isnan(expected[::-1]))
    assert terrain.heights.dtype == np.float32
    assert placed(terrain) == (1, 1, 0, 0)


def test_npz_by_its_names(tmp_path):
    heights = SOUTH_FIRST.astype(np.float32)
    np.savez(tmp_path / "x.npz", heights=heights, dx=3, dy=4.0, x0=5, mask=np.zeros(3))
    terrain = load_heights(tmp_path / "x.npz")
    np.testing.assert_array_equal(terrain.heights, heights)
    assert placed(terrain) == (3, 4, 5, 0)
    np.savez_compressed(tmp_path / "sole.npz", anything=heights)
    np.testing.assert_array_equal(load_heights(tmp_path / "sole.npz").heights, heights)


def test_jacksboro():
    pytest.importorskip("matplotlib")
    terrain = jacksboro()
    assert terrain.heights.shape == (344, 403)
    assert terrain.heights.dtype == np.float32
    assert (terrain.heights.min(), terrain.heights.max()) == (236, 1076)
    assert not terrain.nodata.any()
    # A sphere of 6371 km is within 0.6 % of the ellipsoid; the field lies at 36.59 degrees north, with 3" to a cell.
    second = np.radians(3 / 3600) * 6371000
    np.testing.assert_allclose((terrain.dx, terrain.dy), (second * np.cos(np.radians(36.59)), second), rtol=6e-3)
    assert placed(terrain)[2:] == (0, 0)  # as degrees lie, whose file has the north first
    # The Cumberland Mountains fill the south-west, Powell Valley the north-east, the Great Valley the south-east.
    (south_west, south_east), (north_west, _) = [np.array_split(half, 2, 1) for half in np.array_split(terrain.heights, 2)]
    assert south_west.mean() > max(south_east.mean() + 150, north_west.mean())


def test_extras_are_named(tmp_path, monkeypatch):
    for name in ("x.tif", "x.exr"):
        (tmp_path / name).touch()
    for library, call, said in (
        ("rasterio", lambda: load_heights(tmp_path / "x.tif"), r"x.tif: reading .tif needs rasterio: pip .* 'jaxhf\[geo\]'"),
        ("OpenEXR", lambda: load_image(tmp_path / "x.exr"), r"x.exr: reading .exr needs OpenEXR: pip install 'jaxhf\[exr\]'"),
        ("OpenEXR", lambda: save_image(tmp_path / "x.exr", np.ones((2, 2))), r"x.exr: writing .exr needs OpenEXR: pip install"),
        ("trimesh", lambda: save_mesh(tmp_path / "x.glb", Terrain(SQUARE)), r"x.glb: writing .glb needs trimesh: pip install "),
        ("matplotlib", jacksboro, r"pip install 'jaxhf\[plot\]'"),
    ):
        monkeypatch.setitem(sys.modules, library, None)
        with pytest.raises(ValueError, match=said):
            call()


def save(**arrays):
    return lambda path: np.savez(path, **arrays) if path.suffix == ".npz" else np.save(path, *arrays.values())


def lying_npz(path):
    member = io.BytesIO()
    np.lib.format.write_array_header_1_0(member, {"descr": "<f8", "fortran_order": False, "shape": (16000, 16000)})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("heights.npy", member.getvalue())


def lying_tiff(path, side):
    """Of 4 x 4 pixels in 256 x 256 tiles, that declares more."""
    geotiffs.write(path, np.ones((4, 4), np.uint16))
    data = path.read_bytes()
    for tag in (256, 257, 278):  # ImageWidth, ImageLength and RowsPerStrip, of 16 bits
        at = data.index(struct.pack("<HHI", tag, 3, 1))
        data = data[:at] + struct.pack("<HHIHH", tag, 3, 1, side, 0) + data[at + 12 :]
    path.write_bytes(data)


def raster(values: np.ndarray = NORTH_FIRST, **options):
    return lambda path: geotiffs.write(path, values, **options)


SQUARE = np.zeros((2, 2))
GLOBE = {"elevation": SQUARE, "dx": 30.0, "dy": 30.0, "xmin": 0.0, "ymin": 5e6, "ymax": 5e6}


def test_matplotlibs_arrays_lie_where_their_bounds_say(tmp_path):
    """Bounds are those of cells; its own file has ymin and ymax swapped."""
    save(**GLOBE | {"dx": 0.5, "dy": 0.25, "xmin": -84.0, "ymin": 36.5, "ymax": 36.0})(tmp_path / "hills.npz")
    place = load_heights(tmp_path / "hills.npz").georeference
    assert place is not None
    assert place.offset == (-83.75, 36.125)


BAD_FILES = [
    ("line.npy", save(a=np.zeros(4)), {}, "shape (ny, nx), theirs is (4,)"),
    ("empty.npy", save(a=np.zeros((0, 5))), {}, "its size must be positive"),
    ("names.npz", save(a=SQUARE, b=SQUARE), {}, "an array 'heights', or only one, it holds a, b"),
    ("bare.npz", save(elevation=SQUARE, dx=1.0, dy=1.0), {}, "beside 'elevation' it must hold xmin, ymax, ymin"),
    ("metres.npz", save(**GLOBE), {}, "degrees must lie on a globe"),
    ("lying.npz", lying_npz, {}, "its header declares 2048000000 bytes of data, 0 are there"),
    ("rgb.png", lambda path: Image.new("RGB", (2, 2)).save(path), {}, "it has red, green and blue of 8 bits"),
    ("bomb.png", png((40000, 40000, 16, 0, 0, 0, 0), b""), {}, f"at most {MAX_PIXELS} pixels, it declares 40000 x 40000"),
    ("lying.tif", lambda path: lying_tiff(path, 16000), {}, "it is cut off, damaged or of another kind"),
    ("bomb.tif", lambda path: lying_tiff(path, 40000), {}, f"at most {MAX_PIXELS} pixels, it declares 40000 x 40000"),
    ("rgb.tif", raster(np.zeros((3, 4, 4), np.uint8)), {}, "must be one band, it has 3"),
    ("scale.tif", raster(about={"scales": (0,), "offsets": (-500,)}), {}, "the scale not zero; they are 0.0 and -500.0"),
    ("grads.tif", lambda path: write_degrees(path, {2054: 9105}), {}, "must be in degrees, their unit is grad"),
    ("rotated.tif", raster(place=(30, 5, 0, 0, -20, 0)), {}, "its pixels must lie along x and y"),
    ("high.npy", save(a=np.full((2, 2), 1e300)), {"z_scale": 1e10}, "heights times z_scale must fit into float64"),
    ("cut.asc", raw(b"ncols 3\nnrows 2\ncellsize 1\n1 2 3 4"), {}, "3 x 2 heights take 6 numbers, it holds 4"),
    ("comma.asc", raw(b"ncols 2\nnrows 2\ncellsize 1\n1,5 2 3 4"), {}, "not all of its heights are numbers"),
    ("bomb.asc", raw(b"ncols 99999\nnrows 99999\ncellsize 1\n"), {}, "it declares 99999 x 99999"),
    ("tile.hgt", raw(b"12"), {}, "its name must begin with its south-western corner"),
    ("N01E002.hgt", raw(b"12"), {}, "its size is 2 bytes"),
    ("bomb.hfield", raw(np.array([99999, 99999], "<i4").tobytes()), {}, "it declares 99999 x 99999"),
    ("short.bin", raw(b"123"), {}, "it must begin with the numbers of rows and columns"),
    ("x.npy", save(a=SQUARE), {"dx": 0.0}, "dx must be positive and finite, it is 0.0"),
    ("x.npy", save(a=SQUARE), {"z_scale": 0.0}, "z_scale must be finite and not zero, it is 0.0"),
    ("x.tfi", raw(b""), {}, "cannot read heights from the ending '.tfi'; did you mean '.tif'?"),
]


@pytest.mark.parametrize(("name", "make", "arguments", "message"), BAD_FILES, ids=[f"{row[0]} {row[2]}" for row in BAD_FILES])
def test_what_is_not_terrain_is_refused_by_name(tmp_path, name, make, arguments, message):
    path = tmp_path / name
    make(path)
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        load_heights(path, **arguments)
    assert str(path) in str(error.value)


def test_a_terrain_becomes_a_heightfield():
    terrain = Terrain(np.array([[1, np.nan, 3], [4, 5, 1e30]]), 30.0, 20.5, 500000.25, 4.1e6)
    field = terrain.heightfield()  # in the precision that JAX has
    np.testing.assert_array_equal(field.heights, terrain.heights.astype(np.float32))
    assert field.heights.dtype == np.float32
    assert placed(field) == placed(terrain)
    with jax.enable_x64(True):
        assert terrain.heightfield().heights.dtype == np.float64
        assert terrain.heightfield(np.float32).heights.dtype == np.float32
    terrain.heights[0, 0] = 1e39
    with pytest.raises(ValueError, match=r"heights must fit into float32, the largest is 1e\+39"):
        terrain.heightfield()


@pytest.mark.parametrize("ending", [".npy", ".npz", ".tif"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_written_heights_are_read_back(tmp_path, ending, dtype):
    if ending == ".tif":
        pytest.importorskip("rasterio")
    heights = np.array([[1, np.nan, 3], [4, 5, np.pi]], dtype)
    terrain = Terrain(heights, 30.0, 20.5, 500000.25, 4.1e6)
    save_heights(tmp_path / f"x{ending}", terrain)
    again = load_heights(tmp_path / f"x{ending}")
    np.testing.assert_array_equal(again.heights, heights)
    assert again.heights.dtype == dtype
    assert placed(again) == ((1, 1, 0, 0) if ending == ".npy" else placed(terrain))
    assert [path.name for path in tmp_path.iterdir()] == [f"x{ending}"]


@pytest.mark.parametrize("crs", ["EPSG:32616", "EPSG:4326"])
@pytest.mark.parametrize("kind", ["Area", "Point"])
def test_a_geotiff_may_take_over_the_place_of_another(tmp_path, crs, kind):
    """The rows are flipped back, and its place is the other's."""
    rasterio = pytest.importorskip("rasterio")
    with rasterio.open(geotiffs.write(tmp_path / "a.tif", NORTH_FIRST, (0.5, 0, 7, 0, -0.25, 40), crs), "r+") as a:
        a.update_tags(AREA_OR_POINT=kind)
    first = load_heights(tmp_path / "a.tif")
    save_heights(tmp_path / "b.tif", Terrain(first.heights * 2), like=tmp_path / "a.tif")
    second = load_heights(tmp_path / "b.tif")
    np.testing.assert_array_equal(second.heights, SOUTH_FIRST * 2)
    assert placed(second) == placed(first)
    assert placed(second) != (1, 1, 0, 0)
    with rasterio.open(tmp_path / "a.tif") as a, rasterio.open(tmp_path / "b.tif") as b:
        assert (a.transform, a.crs) == (b.transform, b.crs)
        assert a.tags()["AREA_OR_POINT"] == b.tags()["AREA_OR_POINT"] == kind
    with pytest.raises(ValueError, match=r"a\.tif: it must have the shape of the heights, \(3, 3\); it has \(2, 3\)"):
        save_heights(tmp_path / "c.tif", Terrain(np.zeros((3, 3))), like=tmp_path / "a.tif")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.tif", "b.tif"]


def test_bare_heights_are_written_where_no_place_goes_with_them(tmp_path):
    save_heights(tmp_path / "x.npy", jnp.asarray([[1.0, 2.5], [3, 4]], jnp.float32))
    again = load_heights(tmp_path / "x.npy").heights
    np.testing.assert_array_equal(again, [[1, 2.5], [3, 4]])
    assert again.dtype == np.float32
    with pytest.raises(FileNotFoundError, match="none: there is no such file"):
        load_heights(tmp_path / "none")
    with pytest.raises(FileNotFoundError, match=r"y\.npy: there is no folder"):
        save_heights(tmp_path / "none" / "y.npy", again)
    (tmp_path / "z.npy").mkdir()
    for name, heights, message in (
        ("y.npz", SQUARE, "y.npz: what is written must be a Terrain, whose place goes with it; it is a ndarray"),
        ("y.npy", np.zeros(4), "heights must be a Terrain, or float32 or float64 of shape (ny, nx); they are float64 of"),
        ("y.npy", np.zeros((2, 2), int), "they are int64 of shape (2, 2)"),
        ("y.hgt", again, "y.hgt: cannot write heights with the ending '.hgt'"),
        ("z.npy", again, "z.npy: heights cannot be written here, it is a folder"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            save_heights(tmp_path / name, heights)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["x.npy", "z.npy"]
