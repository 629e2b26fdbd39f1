"""Images come back as they were written, and what is not an image is refused by name."""

import re
import struct
import zlib

import jax.numpy as jnp
import numpy as np
import pytest
from geotiffs import write as geotiff
from PIL import Image

from jaxhf import load_image, save_image
from jaxhf.io.files import MAX_PIXELS
from jaxhf.io.pictures.images import load_numbers, require_writable


@pytest.fixture
def image():
    return np.random.default_rng(0).random((5, 7, 3)).astype(np.float32)


def write_png(path, header, rows, parts=None):
    """A .png put together by hand: `header` is (width, height, depth, colour type, 0, 0, interlaced)."""

    def part(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    chunks = [part(b"IHDR", struct.pack(">IIBBBBB", *header)), part(b"IDAT", zlib.compress(rows)), part(b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks[:parts]))


@pytest.mark.parametrize("ending", [".exr", ".pfm", ".npy", ".PFM", ".png"])
def test_formats_keep_what_they_hold(tmp_path, image, ending):
    """Floats every bit; grey becomes three equal channels."""
    # The steepest step of the curve near 1 is 1/255 encoded = 0.9 % linear, so half a step is below 0.005.
    off = 5e-3 if ending == ".png" else 0
    if not off:
        image[0, 0], image[1, 1] = (np.nan, np.inf, -np.inf), (1e30, -1e-30, -5)
    for given in (image, image[:, :, 0]):
        save_image(tmp_path / f"x{ending}", given)
        back = load_image(tmp_path / f"x{ending}")
        assert back.dtype == np.float32
        np.testing.assert_allclose(back, given if given.ndim == 3 else np.repeat(given[..., None], 3, axis=2), rtol=0, atol=off)


def test_png_holds_every_byte_of_srgb(tmp_path):
    # 0.5 -> 188 and 0.002 -> 0.02584 * 255 = 6.6 -> 7 are worked out by hand from the two pieces of the curve.
    save_image(tmp_path / "x.png", np.array([[0.0, 1.0, 0.5, 0.002, -3.0, 9.0, np.nan, np.inf, -np.inf]]))
    with Image.open(tmp_path / "x.png") as written:
        assert np.asarray(written).tolist() == [[0, 255, 188, 7, 0, 255, 0, 255, 0]]
    every = np.arange(256, dtype=np.uint8)[None]
    Image.fromarray(every).save(tmp_path / "every.png")
    save_image(tmp_path / "again.png", load_image(tmp_path / "every.png"))
    with Image.open(tmp_path / "again.png") as written:
        np.testing.assert_array_equal(np.asarray(written)[:, :, 1], every)


def test_linear_bytes_are_proportional_to_radiance(tmp_path):
    image = np.array([[0.0, 1.0, 0.5, 0.002, -3.0, 9.0, np.nan]])
    save_image(tmp_path / "x.png", image, transfer="linear")
    with Image.open(tmp_path / "x.png") as written:
        assert np.asarray(written).tolist() == [[0, 255, 128, 1, 0, 255, 0]]
    read = load_image(tmp_path / "x.png", transfer="linear")
    np.testing.assert_allclose(read[0, :, 1], np.array([0, 255, 128, 1, 0, 255, 0]) / 255, rtol=1e-6)
    np.testing.assert_allclose(load_image(tmp_path / "x.png")[0, 2], ((128 / 255 + 0.055) / 1.055) ** 2.4, rtol=1e-6)
    save_image(tmp_path / "x.npy", image, transfer="linear")
    np.testing.assert_array_equal(np.load(tmp_path / "x.npy"), image)
    for name, call in (("save", lambda path, **how: save_image(path, image, **how)), ("load", load_image)):
        with pytest.raises(ValueError, match=f"{name}_image: transfer must be one of srgb, linear; it is 'gamma'"):
            call(tmp_path / "x.png", transfer="gamma")


def test_exr_channels_stay_in_order(tmp_path):
    exr = pytest.importorskip("OpenEXR")
    planes = {"B": 3.0, "A": 9.0, "R": 1.0, "G": 2.0}  # the file sorts them by name
    with exr.File({}, {name: np.full((2, 4), value, np.float16) for name, value in planes.items()}) as file:
        file.write(str(tmp_path / "x.exr"))
    np.testing.assert_array_equal(load_image(tmp_path / "x.exr"), np.broadcast_to([1, 2, 3], (2, 4, 3)))


def test_aovs_are_layers_of_an_exr(tmp_path, image):
    exr = pytest.importorskip("OpenEXR")
    depth, cell, status = np.full((5, 7), np.inf), np.arange(70).reshape(5, 7, 2), jnp.ones((5, 7), int)
    aovs = {"depth": depth, "normal": image + 1, "uv": image[:, :, :2], "cell": cell, "status": status}
    save_image(tmp_path / "x.exr", image, aovs=aovs)
    np.testing.assert_array_equal(load_image(tmp_path / "x.exr"), image)
    with exr.File(str(tmp_path / "x.exr"), separate_channels=True) as file:
        found = {name: channel.pixels for name, channel in file.channels().items()}
    layers = {"depth.Z": depth, "cell.0": cell[:, :, 0], "cell.1": cell[:, :, 1], "status.V": np.ones((5, 7))}
    layers |= {f"normal.{letter}": image[:, :, c] + 1 for c, letter in enumerate("XYZ")}
    layers |= {f"uv.{letter}": image[:, :, c] for c, letter in enumerate("UV")}
    layers |= {letter: image[:, :, c] for c, letter in enumerate("RGB")}
    assert found.keys() == layers.keys()
    for name, values in layers.items():
        np.testing.assert_array_equal(found[name], values)
    with pytest.raises(ValueError, match=r"save_image: aovs are layers of an \.exr"):
        save_image(tmp_path / "x.png", image, aovs=aovs)
    with pytest.raises(ValueError, match=r"save_image: aovs\['cell'\] must have the image's size, \(5, 7\), it has \(5, 2\)"):
        save_image(tmp_path / "y.exr", image, aovs={"cell": cell[:, 0]})
    assert [path.name for path in tmp_path.iterdir()] == ["x.exr"]


def test_pfm_by_hand(tmp_path, image):
    """Two rows of one pixel; the file starts at the bottom, and a negative scale says that the least byte comes first."""
    for order, scale in (("<", b"-1.0"), (">", b"2.5e0")):
        (tmp_path / "x.pfm").write_bytes(b"PF\n1 2\n" + scale + b"\n" + struct.pack(f"{order}6f", 1, 2, 3, 4, 5, 6))
        np.testing.assert_array_equal(load_image(tmp_path / "x.pfm"), [[[4, 5, 6]], [[1, 2, 3]]])
        (tmp_path / "y.pfm").write_bytes(b"Pf 1 2 " + scale + b" " + struct.pack(f"{order}2f", 1, 2))
        np.testing.assert_array_equal(load_image(tmp_path / "y.pfm")[:, :, 0], [[2], [1]])
    for dtype, stored in ((jnp.float16, np.float16), (jnp.bfloat16, np.float32)):  # arrays of JAX's, too
        save_image(tmp_path / "a.npy", jnp.asarray(image, dtype))
        assert np.load(tmp_path / "a.npy").dtype == stored


@pytest.mark.parametrize("interlaced", [0, 1])
def test_16_bit_grey_keeps_every_bit(tmp_path, interlaced):
    """Of 2 x 1 pixels: interlaced, they stand in the first and in the sixth pass."""
    rows = b"\x00\x01\x02" + b"\x00\xff\xfe" if interlaced else b"\x00\x01\x02\xff\xfe"
    write_png(tmp_path / "x.png", (2, 1, 16, 0, 0, 0, interlaced), rows)
    np.testing.assert_allclose(load_numbers(tmp_path / "x.png")[0, :, 1], np.array([0x0102, 0xFFFE]) / 65535, rtol=1e-6)
    linear = load_image(tmp_path / "x.png", transfer="linear")
    np.testing.assert_allclose(linear[0, :, 1], np.array([0x0102, 0xFFFE]) / 65535, rtol=1e-6)
    encoded = np.array([0x0102 / 65535 / 12.92, ((0xFFFE / 65535 + 0.055) / 1.055) ** 2.4])
    np.testing.assert_allclose(load_image(tmp_path / "x.png", transfer="srgb")[0, :, 1], encoded, rtol=1e-6)
    with pytest.warns(UserWarning, match=r"x\.png: its 16-bit values are taken for sRGB; transfer = 'srgb' or 'linear' says"):
        np.testing.assert_allclose(load_image(tmp_path / "x.png")[0, :, 1], encoded, rtol=1e-6)


def test_orthophotos(tmp_path):
    """Top row first, as they are stored: colours and greys of bytes, of 16 bits and in floats."""
    stored = np.random.default_rng(0).integers(0, 256, (4, 3, 5)).astype(np.uint8)
    linear = np.where(stored / 255 <= 0.04045, stored / 255 / 12.92, ((stored / 255 + 0.055) / 1.055) ** 2.4)
    found = load_image(geotiff(tmp_path / "rgb.tif", stored[:3], photometric="rgb"))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, np.moveaxis(linear[:3], 0, -1), rtol=1e-6)
    near_infrared = load_image(geotiff(tmp_path / "four.tiff", stored, photometric="rgb", alpha="unspecified"))
    np.testing.assert_array_equal(near_infrared, found)
    grey = load_image(geotiff(tmp_path / "grey.tif", stored[:1]), transfer="linear")
    np.testing.assert_allclose(grey, np.repeat(stored[0, :, :, None], 3, -1) / 255, rtol=1e-6)
    with pytest.warns(UserWarning, match=r"deep\.tif: its 16-bit values"):
        load_image(geotiff(tmp_path / "deep.tif", stored[:1].astype(np.uint16)))
    floats = (stored[:1] / np.float32(9)).astype(np.float32)
    np.testing.assert_array_equal(load_image(geotiff(tmp_path / "f.tif", floats))[:, :, 1], floats[0])
    palette = geotiff(tmp_path / "palette.tif", np.array([[0, 1, 2]], np.uint8))
    with pytest.importorskip("rasterio").open(palette, "r+") as file:
        file.write_colormap(1, {0: (0, 0, 0), 1: (255, 0, 0), 2: (255, 255, 255)})
    np.testing.assert_array_equal(load_image(palette), [[[0, 0, 0], [1, 0, 0], [1, 1, 1]]])


def test_what_a_geotiff_leaves_out_is_nan_in_a_picture_and_0_in_weights(tmp_path):
    stored = np.array([[[7, 255], [9, 255]]], np.uint8)
    opacity = np.array([[[255, 255], [0, 255]]], np.uint8)
    for path, where in (
        (geotiff(tmp_path / "nodata.tif", stored, nodata=7), (0, 0)),
        (geotiff(tmp_path / "alpha.tif", np.concatenate([stored] * 3 + [opacity]), photometric="rgb", alpha="yes"), (1, 0)),
    ):
        missing = np.zeros((2, 2), bool)
        missing[where] = True
        np.testing.assert_array_equal(np.isnan(load_image(path)), np.repeat(missing[..., None], 3, -1))
        np.testing.assert_array_equal(load_numbers(path)[..., 0], np.where(missing, 0, stored[0] / np.float32(255)))


@pytest.mark.parametrize("mode", ["RGBA", "LA", "P", "1", "RGB"])
def test_8_bit_modes_of_png(tmp_path, mode):
    """White at the top left, black elsewhere; alpha 0 everywhere leaves the colours as they are."""
    picture = Image.new("RGB", (3, 2))
    picture.putpixel((0, 0), (255, 255, 255))
    picture = picture.convert(mode)
    if "A" in mode:
        picture.putalpha(0)
    if mode == "P":
        picture.info["transparency"] = b"\x00\x00"
    picture.save(tmp_path / "x.png")
    image = load_image(tmp_path / "x.png")
    assert image.shape == (2, 3, 3)
    np.testing.assert_array_equal(image[0, 0], 1)
    assert image.sum() == 3
    # 5 x 3 grey in the seven passes of Adam7: pass 1, 2, 4, 5, 6 and 7 have rows, pass 3 has none.
    passes = [(1, 1), (1, 1), (0, 0), (1, 1), (1, 3), (2, 2), (1, 5)]
    write_png(tmp_path / "y.png", (5, 3, 8, 0, 0, 0, 1), b"".join((b"\x00" + b"\xff" * w) * h for h, w in passes))
    np.testing.assert_array_equal(load_image(tmp_path / "y.png"), 1)


def lying_npy(side):
    def make(path):
        with path.open("wb") as file:
            np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": (side, side)})
            file.write(bytes(64))

    return make


def damaged(change):
    def make(path):
        save_image(path, np.random.default_rng(0).random((40, 40, 3)))
        path.write_bytes(change(path.read_bytes()))

    return make


cut = damaged(lambda data: data[: int(len(data) * 0.6)])
flipped_bit = damaged(lambda data: data[: len(data) // 2] + bytes([data[len(data) // 2] ^ 4]) + data[len(data) // 2 + 1 :])


def depth_exr(path):
    exr = pytest.importorskip("OpenEXR")
    with exr.File({}, {"Z": np.zeros((2, 2), np.float32)}) as file:
        file.write(str(path))


def png(header, rows, parts=None):
    return lambda path: write_png(path, header, rows, parts)


def tif(count, dtype):
    return lambda path: geotiff(path, np.zeros((count, 2, 2), dtype), photometric="minisblack")


def raw(data):
    return lambda path: path.write_bytes(data)


BAD_FILES = [
    ("text.png", raw(b"not a picture"), "it is not a PNG"),
    ("text.jpg", raw(b"not a picture"), "not a JPEG"),
    ("text.exr", raw(b"not a picture"), "it is not an OpenEXR file"),
    ("cut.png", cut, "it is cut off inside its part 'IDAT'"),
    ("short.png", png((9, 9, 8, 2, 0, 0, 0), bytes(28 * 5)), "9 x 9 pixels take 252 bytes, it holds 140"),
    ("noend.png", png((1, 1, 8, 0, 0, 0, 0), bytes(2), parts=2), "its end mark is missing"),
    ("bomb.png", png((60000, 60000, 8, 2, 0, 0, 0), b""), f"at most {MAX_PIXELS} pixels"),
    ("filter.png", png((1, 1, 16, 0, 0, 0, 0), b"\x07ab"), "unrecognized data stream"),
    ("rgb16.png", png((1, 1, 16, 2, 0, 0, 0), bytes(7)), "16 bits must be grey, it has 3 channels"),
    ("bit.png", flipped_bit, "the checksum of its part 'IDAT' is wrong"),
    ("cut.jpg", cut, "truncated"),
    ("text.webp", raw(b"not a picture"), "it is not a WebP"),
    ("cut.webp", cut, "cut.webp: "),
    ("depth.exr", depth_exr, "its channels must be R, G, B or Y, they are Z"),
    ("cut.pfm", cut, "40 x 40 pixels take 19200 bytes"),
    ("bomb.pfm", raw(b"Pf\n99999999 99999999\n-1\n"), "99999999 x 99999999"),
    ("cut.npy", cut, "its header declares 38400 bytes of data"),
    ("lying.npy", lying_npy(16000), "its header declares 1024000000 bytes of data, 64 are there"),
    ("huge.npy", lying_npy(2**40), f"at most {MAX_PIXELS} pixels"),
    ("rgba.npy", lambda path: np.save(path, np.zeros((2, 2, 4))), "shape (h, w, 3) or (h, w), it has (2, 2, 4)"),
    ("five.tif", tif(5, np.uint8), "a picture must have 1, 3 or 4 bands, it has 5"),
    ("signed.tif", tif(1, np.int16), "a picture must be of uint8, "),
    ("large.tif", tif(1, np.uint8), "it must hold at most 3 pixels, it declares 2 x 2"),
    ("no.tif", raw(b"no TIFF"), "it is cut off, damaged or of another kind"),
    ("x.tga", raw(b""), "cannot read an image with the ending '.tga'; known: .exr, .jpeg"),
    ("x", raw(b""), "a name without an ending; known: .exr, .jpeg, .jpg, .npy, .pfm, .png"),
]


@pytest.mark.parametrize(("name", "make", "message"), BAD_FILES, ids=[name for name, _, _ in BAD_FILES])
def test_what_is_not_an_image_is_refused_by_name(tmp_path, name, make, message, monkeypatch):
    if name == "large.tif":
        monkeypatch.setattr("jaxhf.io.files.MAX_PIXELS", 3)
    path = tmp_path / name
    make(path)
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        load_image(path)
    assert str(path) in str(error.value)


def test_what_cannot_be_written(tmp_path):
    """Nor read, where it is no file."""
    for image, message in (
        (np.zeros((2, 2, 4)), r"shape \(h, w, 3\) or \(h, w\), this one has \(2, 2, 4\)"),
        (np.zeros((0, 2, 3)), r"this one has \(0, 2, 3\)"),
        (np.full((2, 2, 3), 255, np.uint8), "must hold linear radiance in floats, 1 being white; this one holds uint8"),
        (jnp.ones((2, 2), int), "this one holds int32"),
    ):
        with pytest.raises(ValueError, match=message):
            save_image(tmp_path / "x.png", image)
    (tmp_path / "file").touch()
    (tmp_path / "folder.png").mkdir()
    for name, kind, message in (
        ("x.pngg", ValueError, "cannot write an image with the ending '.pngg'; did you mean '.png'"),
        ("x", ValueError, "without an ending"),
        ("file/x.png", FileNotFoundError, "there is no folder"),
        ("folder.png", ValueError, "it is a folder"),
    ):
        for call in (require_writable, lambda path: save_image(path, np.zeros((2, 2)))):
            with pytest.raises(kind, match=message) as error:
                call(tmp_path / name)
            assert name in str(error.value)
    assert require_writable(tmp_path / "good.png") == tmp_path / "good.png"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.png"]
    with pytest.raises(FileNotFoundError, match="none: there is no such file"):
        load_image(tmp_path / "none")
    with pytest.raises(ValueError, match="must be a file"):
        load_image(tmp_path)


def test_a_link_stays_a_link_and_the_mode_is_the_usual_one(tmp_path, image):
    (tmp_path / "link.npy").symlink_to(tmp_path / "real.npy")
    save_image(tmp_path / "link.npy", image)
    assert (tmp_path / "link.npy").is_symlink()
    (tmp_path / "plain").touch()
    assert (tmp_path / "real.npy").stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.parametrize("shape", [(16, 24, 3), (16, 24)])
@pytest.mark.parametrize("transfer", ["srgb", "linear"])
def test_a_jpeg_and_a_webp_hold_what_a_png_holds(tmp_path, shape, transfer):
    """To the error of its compression, of a smooth picture."""
    y, x = np.meshgrid(np.linspace(0, 1, 16), np.linspace(-0.2, 1.2, 24), indexing="ij")
    image = (np.stack([x, y, 1 - x], axis=-1) if len(shape) == 3 else x * y).astype(np.float32)
    for ending in ("png", "jpg", "JPEG", "webp"):
        save_image(tmp_path / f"a.{ending}", image, transfer=transfer)
    png, *others = (load_image(tmp_path / f"a.{ending}", transfer="linear") for ending in ("png", "jpg", "JPEG", "webp"))
    np.testing.assert_allclose(others[:2], [png, png], atol=0.03)
    assert np.abs(others[2] - png).mean() < 0.02  # which has the hue of every second pixel
    for ending, kind, grey, most in (("jpg", "JPEG", "L", 65500), ("webp", "WebP", "RGB", 16383)):
        with Image.open(tmp_path / f"a.{ending}") as stored:
            assert (stored.format, stored.size, stored.mode) == (kind.upper(), (24, 16), "RGB" if len(shape) == 3 else grey)
        with pytest.raises(ValueError, match=f"a {kind} has at most {most} pixels a side, this has {most + 1} x 1"):
            save_image(tmp_path / f"b.{ending}", np.zeros((1, most + 1)))
        assert not (tmp_path / f"b.{ending}").exists()


def test_a_pillow_without_webp_is_told_first(tmp_path, monkeypatch):
    monkeypatch.setattr("PIL.features.check", lambda feature: feature != "webp")
    with pytest.raises(ValueError, match=r"a\.webp: the Pillow that is installed was built without WebP; write \.png or \.jpg"):
        require_writable(tmp_path / "a.webp")
