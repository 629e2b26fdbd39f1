"""Maps lie where their terrain does, as GDAL and GIS programs see it."""

import numpy as np
import pytest

from jaxhf import Terrain, load_heights, save_heights
from jaxhf.io.rasters import save_raster

rasterio = pytest.importorskip("rasterio")

VALUES = np.arange(12, dtype=np.float32).reshape(3, 4)


@pytest.fixture
def utm(tmp_path):
    return load_heights(write(tmp_path / "utm.tif", VALUES, (30, 0, 5e5, 0, -20, 4e6), crs="EPSG:32616", nodata=7))


def write(path, values, transform, **profile):
    profile = {"driver": "GTiff", "transform": rasterio.Affine(*transform), **profile}
    with rasterio.open(path, "w", height=3, width=4, count=1, dtype=values.dtype, **profile) as dataset:
        dataset.write(values, 1)
    return path


@pytest.mark.parametrize(
    "values",
    [
        VALUES,
        VALUES.astype(np.float64),
        VALUES.astype(np.uint8),
        np.arange(36, dtype=np.uint8).reshape(3, 4, 3),
        np.arange(48, dtype=np.uint8).reshape(3, 4, 4),
    ],
    ids=lambda values: f"{values.dtype}{values.shape}",
)
def test_a_map_keeps_place_and_system(tmp_path, utm, values):
    save_raster(tmp_path / "map.tif", values, utm, nodata=3.0)
    with rasterio.open(tmp_path / "map.tif") as found, rasterio.open(tmp_path / "utm.tif") as source:
        assert (found.transform, found.crs, found.nodata) == (source.transform, source.crs, 3)
        written = np.moveaxis(found.read(), 0, -1)
        np.testing.assert_array_equal(written, values[::-1].reshape(written.shape))
        assert written.dtype == values.dtype


def test_a_part_of_a_terrain_in_degrees_lies_in_its_place(tmp_path):
    path = write(tmp_path / "a.tif", VALUES, (0.01, 0, -85, 0, -0.02, 37), crs="EPSG:4326")
    whole = load_heights(path)
    part = Terrain(
        whole.heights[1:, 1:], whole.dx, whole.dy, whole.x0 + whole.dx, whole.y0 + whole.dy, whole.crs, whole.georeference
    )
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
    save_raster(tmp_path / "map.png", VALUES.astype(np.uint8), utm)
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
