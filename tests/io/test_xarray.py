"""Arrays with coordinates, as xarray and rioxarray have them."""

import geotiffs
import numpy as np
import pytest
from alike import placed

from jaxhf import Terrain, load_heights, save_heights

xarray = pytest.importorskip("xarray")

SOUTH_FIRST = np.array([[4, 5, 6], [1, 2, 3]], np.float32)
X, Y = [500.0, 530.0, 560.0], [40.0, 60.0]


def on(x, values: np.ndarray = SOUTH_FIRST):
    return xarray.DataArray(values, dims=("y", "x"), coords={"y": Y, "x": x})


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("north_first", [False, True])
@pytest.mark.parametrize("west_first", [False, True])
def test_any_order_of_dimensions_and_either_direction(turned, north_first, west_first):
    array = on(X).expand_dims("band")
    array = array[:, :: -1 if north_first else 1, :: 1 if west_first else -1]
    terrain = Terrain.from_xarray(array.transpose("x", "band", "y") if turned else array)
    np.testing.assert_array_equal(terrain.heights, SOUTH_FIRST)
    assert placed(terrain) == (30, 20, 500, 40)


def test_as_the_file_itself(tmp_path):
    """rioxarray's way of a GeoTIFF in degrees, with holes, scale and offset: what it puts into coordinates and attributes."""
    rasterio = pytest.importorskip("rasterio")
    stored = np.array([[1, 2, 3], [4, -9, 6]], np.int16)
    about = {"scales": (0.5,), "offsets": (100,)}
    with rasterio.open(
        geotiffs.write(tmp_path / "x.tif", stored, (0.01, 0, -85, 0, -0.01, 37), "EPSG:4269", about, nodata=-9)
    ) as x:
        wkt = x.crs.to_wkt()
    place = xarray.DataArray(0, attrs={"crs_wkt": wkt})
    coords = {"x": -85 + 0.01 * np.array([0.5, 1.5, 2.5]), "y": 37 - 0.01 * np.array([0.5, 1.5]), "spatial_ref": place}
    attrs = {"_FillValue": -9, "scale_factor": 0.5, "add_offset": 100.0}
    array = xarray.DataArray(stored, coords, ("y", "x"), attrs=attrs)
    terrain, expected = Terrain.from_xarray(array), load_heights(tmp_path / "x.tif")
    np.testing.assert_array_equal(terrain.heights, expected.heights)
    np.testing.assert_allclose(placed(terrain), placed(expected), rtol=1e-12)
    assert terrain.dx > 800
    other = Terrain.from_xarray(array, nodata=4.0)  # of what is stored, 0.5 * 4 + 100; the array's own is then a height
    np.testing.assert_array_equal(other.heights, [[np.nan, 0.5 * -9 + 100, 103], [100.5, 101, 101.5]])
    np.testing.assert_array_equal(other.heights, load_heights(tmp_path / "x.tif", nodata=4.0).heights)
    save_heights(tmp_path / "z.tif", other)
    with rasterio.open(tmp_path / "z.tif") as z:
        assert z.nodata == 4
    save_heights(tmp_path / "y.tif", terrain)
    with rasterio.open(tmp_path / "x.tif") as x, rasterio.open(tmp_path / "y.tif") as y:
        assert (x.crs, x.nodata) == (y.crs, y.nodata)
        np.testing.assert_allclose(x.transform[:6], y.transform[:6], rtol=1e-12)


def test_longitude_and_latitude_are_degrees():
    lat, lon = np.linspace(44.9, 45.1, 3), np.linspace(10, 11, 5, dtype=np.float32)
    terrain = Terrain.from_xarray(xarray.DataArray(np.zeros((3, 5)), dims=("lat", "lon"), coords={"lat": lat, "lon": lon}))
    np.testing.assert_allclose((terrain.dx, terrain.dy), (78847 / 4, 111132 / 10), rtol=1e-5)
    assert terrain.georeference is not None
    assert terrain.georeference.name == "WGS 84"
    np.testing.assert_allclose(terrain.in_file, (0.25, 0.1, 10, 44.9))


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (SOUTH_FIRST, "array must be an xarray.DataArray, it is a ndarray"),
        (xarray.Dataset({"z": ("x", X)}), "array must be an xarray.DataArray, it is a Dataset"),
        (xarray.DataArray(SOUTH_FIRST), r"must have dimensions y and x, or lat and lon, it has \('dim_0', 'dim_1'\)"),
        (xarray.DataArray(np.zeros((2, 2, 2)), dims=("band", "y", "x")), "must have dimensions y and x"),
        (xarray.DataArray(SOUTH_FIRST, dims=("y", "x")), "must have coordinates along y"),
        (on([0.0, 1, 3]), r"must have evenly spaced coordinates along x, their steps go from 1\.0 to 2\.0"),
        (on([0.0, 0, 0]), "dx must be positive"),
        (on(X, SOUTH_FIRST > 4), "must be numbers, they are bool"),
    ],
)
def test_what_is_no_terrain_is_refused(array, message):
    with pytest.raises(ValueError, match=message):
        Terrain.from_xarray(array)
