"""Formats of grids that need no library of GDAL's, against GDAL and MuJoCo."""

import re

import numpy as np
import pytest
from alike import placed
from PIL import Image

from jaxhf import Terrain, load_heights, save_heights, save_image
from jaxhf.io.terrain.georeference import CoordinateSystem, Georeference, coordinate_system
from jaxhf.io.terrain.load import read_terrain

UTM = 'LOCAL_CS["a grid of the county",UNIT["metre",1]]'
HEIGHTS = np.array([[1, 2.5, np.nan], [4, 5, 6]], np.float32)


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ("xllcorner 100\nyllcorner 200\ncellsize 10\n", (10, 10, 105, 205)),
        ("xllcenter 100\nyllcenter 200\ncellsize 10\n", (10, 10, 100, 200)),
        ("xllcorner 100\nyllcorner 200\ndx 10\ndy 20\n", (10, 20, 105, 210)),
    ],
)
def test_ascii_grid(tmp_path, place, expected):
    (tmp_path / "x.asc").write_text(f"NCOLS 3\nnrows 2\n{place}NODATA_value -9\n4 5 6\n1 2.5\n-9\n")  # lines do not count
    terrain = load_heights(tmp_path / "x.asc")
    np.testing.assert_array_equal(terrain.heights, HEIGHTS)
    assert placed(terrain) == expected
    assert np.isnan(load_heights(tmp_path / "x.asc", nodata=4.0).heights[1, 0])


@pytest.mark.parametrize(("dtype", "digits"), [(np.float32, 9), (np.float64, 17)])
def test_heights_keep_their_bits_in_text(tmp_path, dtype, digits):
    """And have no more digits than that takes."""
    heights = (1000 * np.random.default_rng(0).uniform(size=(4, 5))).astype(dtype)
    save_heights(tmp_path / "heights.asc", Terrain(heights, 2.0, 2.0))
    words = [line.split() for line in (tmp_path / "heights.asc").read_text().splitlines()[-4:]]
    np.testing.assert_array_equal(np.array(words, float)[::-1].astype(dtype), heights)
    assert max(len(word.replace(".", "")) for row in words for word in row) <= digits


@pytest.mark.parametrize("value", [-9999, -32768, 65535, np.finfo(np.float32).min])
def test_a_value_that_may_mean_none_is_named(tmp_path, value):
    """Not where it is declared, nor where heights lead up to it, as those of a sea bed do."""
    heights = np.arange(12, dtype=np.float32).reshape(3, 4)
    heights[1, 1:3] = value
    np.save(tmp_path / "x.npy", heights)
    said = (
        f"x.npy: {value:.10g} stands for 2 of 12 heights, the others go from 0 to 11; where it means that there is none, nodata"
    )
    with pytest.warns(UserWarning, match=re.escape(said)):
        np.testing.assert_array_equal(load_heights(tmp_path / "x.npy").heights, heights)
    assert load_heights(tmp_path / "x.npy", nodata=float(value)).nodata.sum() == 2
    np.save(tmp_path / "bed.npy", np.linspace(-9999, 100, 100).reshape(10, 10))
    np.save(tmp_path / "flat.npy", np.full((2, 2), -9999.0))
    assert load_heights(tmp_path / "bed.npy").heights.min() == load_heights(tmp_path / "flat.npy").heights.min() == -9999


@pytest.mark.parametrize("name", ["x.asc", "x.tif", "x.png"])
def test_gdal_sees_what_is_written(tmp_path, name):
    rasterio = pytest.importorskip("rasterio")
    heights = np.array([[1, 2, 3], [4, 5, 6]], np.float32) if name == "x.png" else HEIGHTS
    save_heights(tmp_path / name, Terrain(heights, 30.0, 20.5, 500000.25, 4.1e6, CoordinateSystem(), Georeference(UTM)))
    with rasterio.open(tmp_path / name) as dataset:
        np.testing.assert_allclose(dataset.transform[:6], (30, 0, 499985.25, 0, -20.5, 4.1e6 + 1.5 * 20.5), rtol=1e-14)
        found = dataset.read(1, masked=True).astype(np.float32).filled(np.nan)
        np.testing.assert_array_equal(found[::-1], heights)
        if name != "x.png":
            assert dataset.crs.to_wkt().startswith('LOCAL_CS["a grid of the county"')
    again = load_heights(tmp_path / name)
    np.testing.assert_array_equal(again.heights, heights)
    np.testing.assert_allclose(placed(again), (30, 20.5, 500000.25, 4.1e6), rtol=1e-14)
    assert again.georeference is not None
    assert again.georeference.name == "a grid of the county"


def test_srtm_tile(tmp_path):
    rasterio = pytest.importorskip("rasterio")
    stored = np.add.outer(np.arange(1201), np.arange(1201)).astype(">i2")
    stored[0, 0] = -32768
    stored.tofile(tmp_path / "S12E130.hgt")
    terrain = read_terrain(tmp_path / "S12E130.hgt")
    np.testing.assert_array_equal(terrain.heights[-1, :3], [np.nan, 1, 2])
    with rasterio.open(tmp_path / "S12E130.hgt") as dataset:  # its driver SRTMHGT
        a, _, c, _, e, f, *_ = dataset.transform
        np.testing.assert_allclose(placed(terrain), (a, -e, c + a / 2, f + 1200.5 * e), rtol=1e-12)
        np.testing.assert_array_equal(dataset.read(1)[1:], terrain.heights[::-1][1:])
        assert dataset.crs.to_epsg() == coordinate_system(dataset.crs.to_wkt()).code == 4326
    assert 90 < load_heights(tmp_path / "S12E130.hgt").dx < 92


def test_mujoco_height_field(tmp_path):
    """MuJoCo reads the same file, but for its scale to 0..1."""
    mujoco = pytest.importorskip("mujoco")
    heights = np.array([[0, 2, 3], [4, 5, 10]], np.float32)
    path = tmp_path / "x.hfield"
    path.write_bytes(np.array([2, 3], "<i4").tobytes() + heights.astype("<f4").tobytes())
    np.testing.assert_array_equal(load_heights(path).heights, heights)
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><asset><hfield name="h" file="{path}" size="1 1 1 1"/></asset>'
        '<worldbody><geom type="hfield" hfield="h"/></worldbody></mujoco>'
    )
    np.testing.assert_allclose(model.hfield_data.reshape(2, 3), heights / 10)


@pytest.mark.parametrize("ending", [".pfm", ".exr"])
def test_pictures_hold_heights(tmp_path, ending):
    if ending == ".exr":
        pytest.importorskip("OpenEXR")
    Image.fromarray(np.array([[4, 5, 255], [1, 2, 3]], np.uint8)).save(tmp_path / "grey.png")
    np.testing.assert_array_equal(load_heights(tmp_path / "grey.png").heights, [[1, 2, 3], [4, 5, 255]])
    save_image(tmp_path / f"x{ending}", HEIGHTS[::-1])
    np.testing.assert_array_equal(load_heights(tmp_path / f"x{ending}").heights, HEIGHTS)
    if ending == ".exr":
        save_heights(tmp_path / "y.exr", Terrain(HEIGHTS))
        np.testing.assert_array_equal(load_heights(tmp_path / "y.exr").heights, HEIGHTS)
    save_image(tmp_path / f"rgb{ending}", np.zeros((2, 3, 3)))
    with pytest.raises(ValueError, match=r"rgb\.\w+: heights must be one channel, it has (B, G, R|red, green and blue)"):
        load_heights(tmp_path / f"rgb{ending}")


def test_what_a_format_cannot_hold_is_refused(tmp_path):
    """And a world file that is none."""
    for heights, message in (
        (HEIGHTS, "x.png: a .png holds whole heights of 0 to 65535 everywhere, this terrain has holes"),
        (np.array([[-1.0, 2], [3, 70000]]), "goes from -1 to 70000"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            save_heights(tmp_path / "x.png", Terrain(heights))
    assert not list(tmp_path.iterdir())
    Image.fromarray(np.zeros((2, 2), np.uint8)).save(tmp_path / "x.png")
    for text, message in (("1\n2\n", "must hold six numbers"), ("1 0 0 1 0 0", "must put the north up")):
        (tmp_path / "x.pgw").write_text(text)
        with pytest.raises(ValueError, match=rf"x\.png: x\.pgw beside it {message}"):
            load_heights(tmp_path / "x.png")


@pytest.mark.parametrize(
    ("wkt", "expected"),
    [
        # ISO 19162, as PROJ writes it.
        ('GEOGCRS["x",DATUM["d",ELLIPSOID["s",1737400,0,LENGTHUNIT["metre",1]]],PRIMEM["p",0],CS[ellipsoidal,2],'
         'AXIS["lat",north],AXIS["lon",east],ANGLEUNIT["degree",0.0174532925199433],ID["EPSG",12345]]',
         (True, (1737400, 0), 12345)),
        ('PROJCRS["x",BASEGEOGCRS["b",DATUM["d",ELLIPSOID["s",1,0]],ID["EPSG",4326]],CS[Cartesian,2],'
         'LENGTHUNIT["metre",1],ID["EPSG",32616]]', (False, None, 32616)),
        ('COMPD_CS["both",GEOGCS["g",DATUM["d",SPHEROID["s",6378137,298]],UNIT["Degree",0.0174532925199433],'
         'AUTHORITY["EPSG","4326"]],VERT_CS["v",UNIT["metre",1],AUTHORITY["EPSG","5773"]]]',
         (True, (6378137, 1 / 298), 4326)),
        ('PROJCS["x",GEOGCS["g",AUTHORITY["EPSG","4326"]],UNIT["metre",1]]', (False, None, None)),
    ],
)  # fmt: skip
def test_well_known_text(wkt, expected):
    assert coordinate_system(wkt) == expected
