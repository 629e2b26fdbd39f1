"""A map as a sheet: with coordinates, a scale bar, north, what the colours mean, and contour lines; by matplotlib."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from ..core.errors import UserError
from ..io.files import replacing
from ..io.terrain.georeference import Georeference, coordinate_system
from ..io.terrain.terrain import Terrain
from ..maps.ramp import Ramp, coloured

SHEETS = (".png", ".webp", ".pdf", ".svg")
_LINES = 500  # contour lines at most
_DRAWN = 2000  # of the heights along a side, in contour lines: more than are told apart on a page
_INDEX = 5  # each so many of which one is thick and has its height
DPI = 150


def sheet(
    colours: UInt8[np.ndarray, "ny nx 4"],
    terrain: Terrain,
    metres: Terrain,
    ramp: Ramp,
    entries: str,
    contours: float | None,
    title: str | None,
    caption: str,
) -> Any:
    """A map in colours as a figure of matplotlib's.

    `metres` is the terrain with lengths where its file has degrees; contour lines stand so far apart, None: there are none.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    ny, nx = terrain.heights.shape
    tall = ny * metres.dy / (nx * metres.dx)
    width = max(min(7.5, 13 / tall), 2.5)  # of the map, inches
    figure = Figure(figsize=(width + 1.5, max(min(width * tall, 13), 2) + 0.8), layout="constrained")
    axis = figure.subplots()
    (dx, dy, x0, y0), place = terrain.in_file, terrain.georeference or Georeference()
    x, y = x0 + np.arange(nx) * dx, y0 + np.arange(ny) * dy
    extent = x[0] - dx / 2, x[-1] + dx / 2, y[0] - dy / 2, y[-1] + dy / 2
    axis.imshow(colours, origin="lower", extent=extent, aspect=metres.dy / dy * dx / metres.dx)
    low, high = float(np.nanmin(terrain.heights)), float(np.nanmax(terrain.heights))
    if contours is not None:
        every = slice(None, None, math.ceil(max(ny, nx) / _DRAWN))
        _draw_contours(axis, x[every], y[every], terrain.heights[every, every], contours, (low, high))
    degrees = coordinate_system(place.wkt).degrees  # in the file: here lengths are metres all the same
    shown = ListedColormap(coloured(ramp, np.linspace(low, high, 256)[None], entries)[0] / 255)
    unit = place.height_unit or ("m" if degrees else "")
    norm = Normalize(low, max(high, float(np.nextafter(np.float32(low), np.float32(np.inf)))))
    legend = figure.colorbar(ScalarMappable(norm, shown), ax=axis, shrink=0.6)
    legend.set_label(f"height{unit and f', {unit}'}", parse_math=False)
    _draw_scale_bar(axis, *scale_of(nx * metres.dx / 5, place), dx / metres.dx)
    draw_north(axis, terrain.turned_from_north, (0.96, 0.97), 32.0)
    axis.ticklabel_format(useOffset=False, style="plain")
    axis.tick_params(labelsize=7)
    for along, inches in ((axis.xaxis, width), (axis.yaxis, width * tall)):
        along.set_major_locator(MaxNLocator(max(2, int(inches / 1.2))))
    axis.tick_params(axis="y", labelrotation=90)
    axis.set_xlabel(caption, fontsize=8, color="0.3", parse_math=False)
    if title:
        axis.set_title(title, loc="left", parse_math=False)
    return figure


def save_sheet(path: Path, figure: Any) -> None:
    """Writes it as .png, .webp, .pdf or .svg, in which text stays text."""
    import matplotlib

    with replacing(path) as temporary, matplotlib.rc_context({"svg.fonttype": "none", "pdf.fonttype": 42}):
        figure.savefig(temporary, format=path.suffix[1:].lower(), dpi=DPI)


def _draw_contours(axis: Any, x: np.ndarray, y: np.ndarray, z: np.ndarray, step: float, span: tuple[float, float]) -> None:
    if (span[1] - span[0]) / step > _LINES:
        raise UserError(f"relief: --contours must leave at most {_LINES} lines, heights go from {span[0]:g} to {span[1]:g}")
    first, last = math.ceil(span[0] / step), math.floor(span[1] / step)
    numbers = [k for k in range(first, last + 1) if k * step > span[0]]
    for thick, width in ((False, 0.3), (True, 0.8)):
        levels = [k * step for k in numbers if (k % _INDEX == 0) == thick]
        if levels:
            lines = axis.contour(x, y, z, levels=levels, colors="0.15", linewidths=width, alpha=0.7)
            if thick:
                axis.clabel(lines, fontsize=6, fmt="%g")


def scale_of(most: float, place: Georeference) -> tuple[float, str]:
    """The longest length up to `most` with 1, 2 or 5 for its first digit, and its name."""
    power = 10.0 ** math.floor(math.log10(most))
    length = max([power / 2, *(power * digit for digit in (1, 2, 5) if power * digit <= most)])
    in_metres = coordinate_system(place.wkt).degrees or place.unit.lower() in ("metre", "meter", "m")
    if in_metres and length >= 1000:
        return length, f"{length / 1000:g} km"
    return length, f"{length:g} {'m' if in_metres else place.unit}".rstrip()


def _draw_scale_bar(axis: Any, length: float, said: str, drawn: float) -> None:
    """`drawn` is a unit of length in coordinates."""
    from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar

    bar = AnchoredSizeBar(axis.transData, length * drawn, said, "lower left", pad=0.4, borderpad=0.6, sep=3, frameon=True)
    bar.patch.set(alpha=0.7, linewidth=0)
    axis.add_artist(bar)


def draw_north(axis: Any, turned: float, tip: Any, length: float) -> None:
    """An arrow to true north, `turned` degrees counterclockwise of up; its tip as shares of the axes, its length in points."""
    east, north = -math.sin(math.radians(turned)), math.cos(math.radians(turned))
    axis.annotate(
        "N", xy=tip, xycoords="axes fraction", xytext=(-length * east, -length * north), textcoords="offset points",
        ha="center", va="center", weight="bold", size=0.3125 * length, arrowprops={"arrowstyle": "-|>", "facecolor": "k"},
        bbox={"boxstyle": "circle,pad=0.15", "facecolor": "w", "alpha": 0.7, "linewidth": 0},
    )  # fmt: skip
