"""Maps lie where their terrain does, as GDAL and GIS programs see it."""

import warnings

import numpy as np
import pytest
from geotiffs import write

from jaxhf import Terrain, load_heights, save_heights
from jaxhf.cli.main import main
from jaxhf.io.terrain.rasters import save_raster

rasterio = pytest.importorskip("rasterio")

VALUES = np.arange(12, dtype=np.float32).reshape(3, 4)


@pytest.fixture
def utm(tmp_path):
    return load_heights(write(tmp_path / "utm.tif", VALUES, (30, 0, 5e5, 0, -20, 4e6), crs="EPSG:32616", nodata=7))


@pytest.mark.parametrize(
    ("name", "driver"),
    [
        ("x.img", "HFA"), ("x.bil", "EHdr"), ("x.flt", "EHdr"), ("x.grd", "GSBG"), ("x.vrt", "VRT"), ("x.nc", "netCDF"),
        ("x.bil", "ENVI"), ("x.img", "ENVI"),
    ],
)  # fmt: skip
def test_other_rasters_of_gdal(tmp_path, utm, name, driver):
    rasterio_shutil = pytest.importorskip("rasterio.shutil")
    with rasterio.Env() as gdal:
        if driver not in gdal.drivers():
            pytest.skip(f"this GDAL has no {driver}")
    rasterio_shutil.copy(tmp_path / "utm.tif", tmp_path / name, driver=driver)
    found = load_heights(tmp_path / name)
    np.testing.assert_array_equal(found.heights, utm.heights)
    np.testing.assert_allclose(found.in_file, utm.in_file)
    with pytest.raises(ValueError, match=rf"{name}\.tif: it is cut off, damaged or of another kind"):  # its ending decides
        load_heights((tmp_path / name).rename(tmp_path / f"{name}.tif"))


PDS = """PDS_VERSION_ID = PDS3
RECORD_TYPE = FIXED_LENGTH
RECORD_BYTES = {record}
FILE_RECORDS = {records}
LABEL_RECORDS = 1
^IMAGE = {image}
OBJECT = IMAGE
  LINES = 3
  LINE_SAMPLES = 4
  SAMPLE_TYPE = PC_REAL
  SAMPLE_BITS = 32
  BANDS = 1
  MISSING_CONSTANT = 16#FF7FFFFB#
END_OBJECT = IMAGE
OBJECT = IMAGE_MAP_PROJECTION
  MAP_PROJECTION_TYPE = "EQUIRECTANGULAR"
  A_AXIS_RADIUS = 3396.19 <KM>
  B_AXIS_RADIUS = 3396.19 <KM>
  C_AXIS_RADIUS = 3396.19 <KM>
  CENTER_LATITUDE = 0.0 <DEG>
  CENTER_LONGITUDE = 180.0 <DEG>
  MAP_SCALE = 20.0 <METERS/PIXEL>
  LINE_PROJECTION_OFFSET = 5000 <PIXEL>
  SAMPLE_PROJECTION_OFFSET = -2000 <PIXEL>
END_OBJECT = IMAGE_MAP_PROJECTION
END
"""


@pytest.mark.parametrize("detached", [False, True])
def test_what_nasas_planetary_data_system_keeps(tmp_path, detached):
    """With its label before the heights, as those of HiRISE, or in a file of its own."""
    values = VALUES.astype("<f4")
    values[1, 2] = np.uint32(0xFF7FFFFB).view(np.float32)
    if detached:
        (tmp_path / "dtm.img").write_bytes(values.tobytes())
        path = tmp_path / "dtm.lbl"
        path.write_text(PDS.format(record=16, records=3, image='("dtm.img", 1)'))
    else:
        path = tmp_path / "DTM.IMG"
        path.write_bytes(PDS.format(record=4096, records=4, image=2).encode().ljust(4096) + values.tobytes())
    found = load_heights(path)
    np.testing.assert_array_equal(found.heights, np.where(values < -1e30, np.nan, VALUES)[::-1])
    assert (found.dx, found.dy) == (20, 20)
    x, y = found.x0 + 1.5 * found.dx, found.y0 + found.dy
    degree = np.pi / 180 * 3_396_190
    np.testing.assert_allclose(found.place, (y / degree, x / degree - 180), atol=1e-6)
    assert abs(found.place[0]) > 1.5


def test_a_cube_of_isis(tmp_path):
    mars = "+proj=eqc +lat_ts=0 +lon_0=0 +a=3396190 +b=3396190 +units=m"
    path = write(tmp_path / "dtm.tif", VALUES, (20, 0, 4e4, 0, -20, 1e5), crs=mars)
    pytest.importorskip("rasterio.shutil").copy(path, tmp_path / "dtm.cub", driver="ISIS3")
    found, same = load_heights(tmp_path / "dtm.cub"), load_heights(path)
    np.testing.assert_array_equal(found.heights, VALUES[::-1])
    assert found.in_file == same.in_file
    np.testing.assert_allclose(found.place, same.place, atol=1e-6)


@pytest.mark.parametrize("dx", [30, -30])
@pytest.mark.parametrize("dy", [20, -20])
def test_rasters_may_start_in_any_corner(tmp_path, dx, dy):
    terrain = load_heights(write(tmp_path / "x.tiff", VALUES, (dx, 0, 5e5, 0, dy, 4e6)))
    with rasterio.open(tmp_path / "x.tiff") as dataset:
        for iy, ix in np.ndindex(3, 4):
            x, y = dataset.xy(2 - iy if dy < 0 else iy, 3 - ix if dx < 0 else ix)
            assert (terrain.x0 + ix * terrain.dx, terrain.y0 + iy * terrain.dy) == (x, y)
            assert terrain.heights[iy, ix] == next(dataset.sample([(x, y)]))[0]


@pytest.mark.parametrize("dx", [30, -30])
@pytest.mark.parametrize("dy", [20, -20])
def test_a_part_of_a_band(tmp_path, dx, dy):
    """As of all of it, from whatever corner it starts; also of arrays that lie elsewhere than in their file."""
    rng = np.random.default_rng(0)
    bands = rng.uniform(size=(2, 9, 7)).astype(np.float32)
    with rasterio.open(write(tmp_path / "x.tif", bands, (dx, 0, 5e5, 0, dy, 4e6)), "r+") as dataset:
        dataset.write_mask(bands[0] < 0.9)
    whole = load_heights(tmp_path / "x.tif", band=2)
    (ny, nx), (west, south) = whole.heights.shape, (whole.x0, whole.y0)
    assert np.isnan(whole.heights).sum() == (bands[0] >= 0.9).sum()
    box = west + 30, south + 20, west + 4 * 30 + 29, south + 5 * 20
    part = load_heights(tmp_path / "x.tif", band=2, bbox=box)
    np.testing.assert_array_equal(part.heights, whole.heights[1:6, 1:5])
    assert (part.x0, part.y0, part.dx, part.dy) == (west + 30, south + 20, 30, 20)
    all_of_it = load_heights(tmp_path / "x.tif", band=2, bbox=(-1e9, -1e9, 1e9, 1e9))
    np.testing.assert_array_equal(all_of_it.heights, whole.heights)
    np.testing.assert_array_equal(whole.within(box).heights, part.heights)
    save_heights(tmp_path / "y.npz", whole)
    other = load_heights(tmp_path / "y.npz", bbox=box)
    np.testing.assert_array_equal(other.heights, part.heights)
    assert other.in_file == part.in_file
    assert (ny, nx) == (9, 7)


@pytest.mark.parametrize("dx", [30, -30])
@pytest.mark.parametrize("dy", [20, -20])
def test_a_window_counts_from_the_first_pixel(tmp_path, dx, dy):
    """As rasterio's own; of files that are no rasters from the north-west."""
    path = write(tmp_path / "x.tif", np.random.default_rng(0).uniform(size=(9, 7)).astype(np.float32), (dx, 0, 5e5, 0, dy, 4e6))
    part = load_heights(path, window=(1, 1, 3, 5))
    with rasterio.open(path) as dataset:
        pixels = dataset.read(1, window=((1, 6), (1, 4)))
        x, y = dataset.xy(5 if dy < 0 else 1, 3 if dx < 0 else 1)
    np.testing.assert_array_equal(part.heights, pixels[:: -1 if dy < 0 else 1, :: -1 if dx < 0 else 1])
    assert (part.x0, part.y0) == (x, y)
    save_heights(tmp_path / "x.npz", load_heights(path))
    other = load_heights(tmp_path / "x.npz", window=(1 if dx > 0 else 3, 1 if dy < 0 else 3, 3, 5))
    np.testing.assert_array_equal(other.heights, part.heights)
    assert other.in_file == part.in_file


def test_a_part_of_a_raster_without_a_place(tmp_path):
    """Whose file begins in the north, though its geotransform is none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with rasterio.open(tmp_path / "x.tif", "w", driver="GTiff", width=7, height=9, count=1, dtype="float32") as dataset:
            dataset.write(np.random.default_rng(0).uniform(size=(1, 9, 7)).astype(np.float32))
    whole, part = load_heights(tmp_path / "x.tif"), load_heights(tmp_path / "x.tif", bbox=(2.0, 1.0, 4.0, 3.0))
    np.testing.assert_array_equal(part.heights, whole.heights[1:4, 2:5])
    assert (part.x0, part.y0) == (2, 1)


def test_a_part_of_a_terrain_in_degrees(tmp_path):
    """Its box is in degrees, and so it lies where it did."""
    path = write(tmp_path / "d.tif", VALUES, (0.1, 0, 7.0, 0, -0.1, 46.0), crs="EPSG:4326")
    part = load_heights(path, bbox=(7.1, 45.7, 7.3, 45.9))
    np.testing.assert_array_equal(part.heights, VALUES[::-1][:2, 1:3])
    np.testing.assert_allclose(part.in_file, (0.1, 0.1, 7.15, 45.75))
    np.testing.assert_allclose(part.place, (45.8, 7.2))


@pytest.mark.parametrize(
    ("options", "rule"),
    [
        ({"band": 3}, "it has no band 3, it has 1"),
        ({"band": 0}, "band must be a whole number from 1 on, it is 0"),
        ({"bbox": (0, 0, 1)}, "bbox must be west, south, east and north"),
        ({"bbox": (5e5, 4e6, 5e5, 5e6)}, "bbox must be west, south, east and north, finite and in this order"),
        ({"bbox": (5e5, 4e6 - 60, 5e5 + 30, 4e6)}, "must be heights, 2 x 2 at least; they stand at x from 500015 to 500105"),
        ({"window": (0, 0, 5, 3)}, r"within the file's 4 columns and 3 rows, and be 2 x 2 or larger; it is \(0, 0, 5, 3\)"),
        ({"window": (-1, 0, 2, 2)}, "window must lie within the file's 4 columns"),
        ({"window": (0, 2, 2, 2)}, "window must lie within the file's 4 columns"),
        ({"window": (0, 2, 2, 1)}, "window must lie within the file's 4 columns"),
        ({"window": (0, 0.5, 2, 2)}, "window must be a column, a row, and how many columns and rows, whole numbers"),
        ({"window": ("0", "0", "2", "2")}, "whole numbers; it is"),
        ({"window": (0, 0, 2, None)}, "whole numbers; it is"),
        ({"window": (0, 0, 2, 2), "bbox": 5}, "not both: 5 and"),
        ({"window": (0, 0, 2, 2), "bbox": (0, 0, 1, 1)}, "bbox or window must say which heights are taken, not both"),
    ],
)
@pytest.mark.usefixtures("as_users_call_it")
def test_wrong_parts_are_refused(tmp_path, utm, options, rule):
    assert utm.heights.shape == (3, 4)
    with pytest.raises(ValueError, match=rule):
        load_heights(tmp_path / "utm.tif", **options)
    np.save(tmp_path / "z.npy", VALUES)
    if options == {"band": 3}:
        with pytest.raises(ValueError, match="it has no bands, band must be left out; it is 3"):
            load_heights(tmp_path / "z.npy", **options)


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_masks_are_holes_and_ground_control_points_are_refused(tmp_path, capfd):
    with rasterio.open(write(tmp_path / "m.tif", VALUES), "r+") as dataset:
        dataset.write_mask(VALUES != 4)
    np.testing.assert_array_equal(load_heights(tmp_path / "m.tif").nodata, VALUES[::-1] == 4)
    points = [rasterio.control.GroundControlPoint(*numbers) for numbers in ((0, 0, 1, 2), (0, 9, 3, 4), (9, 0, 5, 6))]
    profile = {"driver": "GTiff", "height": 3, "width": 4, "count": 1, "dtype": "float32", "crs": "EPSG:4326"}
    with rasterio.open(tmp_path / "x.tif", "w", **profile) as dataset:
        dataset.gcps = points, dataset.crs
        dataset.write(VALUES, 1)
    with pytest.raises(ValueError, match=r"x\.tif: it must be placed by a geotransform, it has ground control points"):
        load_heights(tmp_path / "x.tif")
    (tmp_path / "x.tif").write_bytes((tmp_path / "x.tif").read_bytes()[:300])
    with pytest.raises(ValueError, match=r"x\.tif: it is cut off, damaged or of another kind"):
        load_heights(tmp_path / "x.tif")
    assert capfd.readouterr() == ("", "")  # GDAL prints nothing itself


def test_a_part_of_a_terrain_in_degrees_lies_in_its_place(tmp_path):
    path = write(tmp_path / "a.tif", VALUES, (0.01, 0, -85, 0, -0.02, 37), crs="EPSG:4326")
    whole = load_heights(path)
    x0, y0 = whole.x0 + whole.dx, whole.y0 + whole.dy
    part = Terrain(whole.heights[1:, 1:], whole.dx, whole.dy, x0, y0, whole.crs, whole.georeference)
    assert part.dx > 800  # metres
    save_raster(tmp_path / "part.tif", part.heights, part)
    with rasterio.open(tmp_path / "part.tif") as found:
        assert found.crs.to_epsg() == 4326
        np.testing.assert_allclose(found.transform[:6], (0.01, 0, -84.99, 0, -0.02, 37), rtol=1e-14)


@pytest.mark.parametrize("crs", ["EPSG:32616", "EPSG:4326", "+proj=longlat +R=1737400"])
def test_conversion_to_and_from_npz_keeps_system_and_nodata(tmp_path, crs):
    values = np.where(VALUES == 5, np.float32(-9999), VALUES + np.float32(0.1))
    write(tmp_path / "a.tif", values, (0.1, 0, -85, 0, -0.2, 37), crs=crs, nodata=-9999, tiled=False)
    for before, after in (("a.tif", "b.npz"), ("b.npz", "c.tif")):
        save_heights(tmp_path / after, load_heights(tmp_path / before))
    with rasterio.open(tmp_path / "a.tif") as first, rasterio.open(tmp_path / "c.tif") as last:
        assert (first.crs, first.nodata, first.tags()) == (last.crs, last.nodata, last.tags())
        np.testing.assert_allclose(first.transform[:6], last.transform[:6], rtol=1e-14)
        np.testing.assert_array_equal(first.read(), last.read())
    a, b = (load_heights(tmp_path / name) for name in ("a.tif", "b.npz"))
    np.testing.assert_array_equal(a.heights, b.heights)
    assert (a.dx, a.dy, a.x0, a.y0, a.crs, a.georeference) == (b.dx, b.dy, b.x0, b.y0, b.crs, b.georeference)


def test_a_picture_has_a_world_file(tmp_path, utm):
    """In the place of the file, whatever coordinates were asked for."""
    moved = load_heights(tmp_path / "utm.tif", dx=3.0, x0=0.0, y0=-7.0)
    assert (moved.dx, moved.dy, moved.x0, moved.y0) == (3, 20, 0, -7)
    assert moved.in_file == utm.in_file == (30, 20, 500015, 3999950)
    save_raster(tmp_path / "map.png", VALUES.astype(np.uint8), moved)
    assert (tmp_path / "map.pgw").read_text().split() == ["30.0", "0.0", "0.0", "-20.0", "500015.0", "3999990.0"]
    with rasterio.open(tmp_path / "map.png") as found, rasterio.open(tmp_path / "utm.tif") as source:
        assert found.transform == source.transform
        np.testing.assert_array_equal(found.read(1), VALUES[::-1])
    save_raster(tmp_path / "map.npy", VALUES, utm)
    np.testing.assert_array_equal(np.load(tmp_path / "map.npy"), VALUES)


def test_what_is_no_map_is_refused(tmp_path, utm):
    for name, values, message in (
        ("x.tif", VALUES[1:], r"values must have the terrain's shape, \(3, 4\), theirs is \(2, 4\)"),
        ("x.tif", np.zeros((3, 4, 3)), r"theirs is \(3, 4, 3\)"),
        ("x.png", VALUES, r"values must be of uint8, uint16 for \.png, they are float32"),
        ("x.jpg", VALUES, r"cannot write a map with the ending '\.jpg'"),
    ):
        with pytest.raises(ValueError, match=message):
            save_raster(tmp_path / name, values, utm)
    assert [path.name for path in tmp_path.iterdir()] == ["utm.tif"]


@pytest.mark.parametrize(
    ("crs", "unit", "hint"),
    [
        ("EPSG:32616", "ft", "its heights are in ft, x and y are not: in metres they would be 0.3048 times that"),
        ("EPSG:4326", "US survey foot", "its heights are in US survey foot, x and y are not"),
        ("EPSG:2263", None, "x and y are in US survey foot, and heights count as such: in metres they must be multiplied"),
        ("EPSG:2263", "m", "x and y are in US survey foot, and heights count as such"),
        ("EPSG:2263", "US survey foot", None),
        ("EPSG:32616", "metre", None),
    ],
)
def test_feet_are_named_where_they_meet_other_units(tmp_path, capsys, crs, unit, hint):
    """By the commands in one line; `z_scale` says that they are known."""
    place = (1e-3, 0, 7, 0, -1e-3, 46) if crs == "EPSG:4326" else (30, 0, 5e5, 0, -20, 4e6)
    write(tmp_path / "x.tif", VALUES, place, crs, {"units": (unit,)})
    if hint is None:
        load_heights(tmp_path / "x.tif")
        return
    with pytest.warns(UserWarning, match=rf"x\.tif: {hint}"):
        load_heights(tmp_path / "x.tif")
    load_heights(tmp_path / "x.tif", z_scale=0.3048)
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert main(["aspect", str(tmp_path / "x.tif"), "-o", str(tmp_path / "y.npy")]) == 0
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith(f"jaxhf: warning: {tmp_path}/x.tif: {hint}")


def test_the_unit_of_heights_goes_with_them(tmp_path):
    """Until they are scaled; not with a map of them."""
    write(tmp_path / "x.tif", VALUES, (30, 0, 5e5, 0, -20, 4e6), "EPSG:2263", {"units": ("US survey foot",)})
    for before, after in (("x.tif", "y.npz"), ("y.npz", "z.tif")):
        save_heights(tmp_path / after, load_heights(tmp_path / before))
        place = load_heights(tmp_path / after).georeference
        assert place
        assert place.height_unit == "US survey foot"
    scaled = load_heights(tmp_path / "z.tif", z_scale=0.3048).georeference
    assert scaled
    assert scaled.height_unit == ""
    save_raster(tmp_path / "map.tif", VALUES, load_heights(tmp_path / "x.tif"))
    with rasterio.open(tmp_path / "map.tif") as dataset:
        assert dataset.units == (None,)


def test_many_latitudes_are_no_metres(tmp_path, capsys):
    """Not those of a tile; converting measures nothing, but for a mesh."""
    write(tmp_path / "tile.tif", VALUES, (1 / 3, 0, 7, 0, -1 / 3, 61), crs="EPSG:4326")
    load_heights(tmp_path / "tile.tif")
    write(tmp_path / "wide.tif", VALUES, (10, 0, 7, 0, -10, 65), crs="EPSG:4326")
    off = r"degrees from latitude 40 to 60 are measured in metres at 50: .* a column's width is off by up to 22 %"
    with pytest.warns(UserWarning, match=off):
        load_heights(tmp_path / "wide.tif")
    load_heights(tmp_path / "wide.tif", dx=1000.0, dy=1000.0)
    assert main(["convert", str(tmp_path / "wide.tif"), str(tmp_path / "wide.npz")]) == 0
    assert capsys.readouterr().err == ""
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert main(["slope", str(tmp_path / "wide.tif"), "-o", str(tmp_path / "slope.npy")]) == 0
    assert sum("off by up to 22 %" in line for line in capsys.readouterr().err.splitlines()) == 1
