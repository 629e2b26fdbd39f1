"""A map as a sheet: with coordinates, a scale bar, north, what the colours mean, and contour lines; by matplotlib."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from ..core.errors import UserError
from ..io.files import replacing
from ..io.terrain.terrain import Terrain
from ..maps.ramp import Ramp, coloured

SHEETS = (".png", ".pdf", ".svg")
_LINES = 500  # contour lines at most
_INDEX = 5  # each so many of which one is thick and has its height


def sheet(
    colours: UInt8[np.ndarray, "ny nx 4"],
    terrain: Terrain,
    metres: Terrain,
    ramp: Ramp,
    contours: float | None,
    title: str | None,
    caption: str,
) -> Any:
    """A map in colours as a figure of matplotlib's.

    Args:
      colours: of each vertex, row 0 in the south, with opacity.
      terrain: as its file has it, maybe in degrees.
      metres: the same with the lengths that count.
      ramp: what colours the heights have.
      contours: how far apart contour lines are, in the unit of the heights; None: there are none.
      title: above it.
      caption: below it.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    ny, nx = terrain.heights.shape
    tall = ny * metres.dy / (nx * metres.dx)
    width = min(7.5, 13 / tall)  # of the map, inches
    figure = Figure(figsize=(width + 1.5, max(width * tall + 0.8, 2)), layout="constrained")
    axis = figure.subplots()
    x, y = terrain.x0 + np.arange(nx) * terrain.dx, terrain.y0 + np.arange(ny) * terrain.dy
    extent = x[0] - terrain.dx / 2, x[-1] + terrain.dx / 2, y[0] - terrain.dy / 2, y[-1] + terrain.dy / 2
    axis.imshow(colours, origin="lower", extent=extent, aspect=metres.dy / terrain.dy * terrain.dx / metres.dx)
    low, high = float(np.nanmin(terrain.heights)), float(np.nanmax(terrain.heights))
    if contours is not None:
        _draw_contours(axis, x, y, terrain.heights, contours, (low, high))
    shown = ListedColormap(coloured(ramp, np.linspace(low, high, 256)[None], "interpolate")[0] / 255)
    unit = terrain.georeference.height_unit if terrain.georeference else ""
    unit = unit or ("m" if terrain.crs is not None and terrain.crs.degrees else "")  # as which they count there
    colour_bar = ScalarMappable(Normalize(low, max(high, np.nextafter(low, np.inf))), shown)
    figure.colorbar(colour_bar, ax=axis, label=f"height{unit and f', {unit}'}", shrink=0.6)
    _draw_scale_bar(axis, terrain, metres)
    _draw_north(axis, terrain.turned_from_north)
    axis.ticklabel_format(useOffset=False, style="plain")
    axis.tick_params(labelsize=7)
    for along, inches in ((axis.xaxis, width), (axis.yaxis, width * tall)):
        along.set_major_locator(MaxNLocator(max(2, int(inches / 1.2))))
    axis.tick_params(axis="y", labelrotation=90)
    axis.set_xlabel(caption, fontsize=8, color="0.3")
    if title:
        axis.set_title(title, loc="left")
    return figure


def save_sheet(path: Path, figure: Any) -> None:
    """Writes it as .png, .pdf or .svg, in which text stays text."""
    import matplotlib

    with replacing(path) as temporary, matplotlib.rc_context({"svg.fonttype": "none", "pdf.fonttype": 42}):
        figure.savefig(temporary, format=path.suffix[1:].lower(), dpi=150)


def _draw_contours(axis: Any, x: np.ndarray, y: np.ndarray, z: np.ndarray, step: float, span: tuple[float, float]) -> None:
    first, last = math.ceil(span[0] / step), math.floor(span[1] / step)
    if last - first > _LINES:
        raise UserError(f"relief: --contours must leave at most {_LINES} lines, {step:g} makes {last - first + 1}")
    numbers = [k for k in range(first, last + 1) if k * step > span[0]]
    for thick, width in ((False, 0.3), (True, 0.8)):
        levels = [k * step for k in numbers if (k % _INDEX == 0) == thick]
        if levels:
            lines = axis.contour(x, y, z, levels=levels, colors="0.15", linewidths=width, alpha=0.7)
            if thick:
                axis.clabel(lines, fontsize=6, fmt="%g")


def _draw_scale_bar(axis: Any, terrain: Terrain, metres: Terrain) -> None:
    """About a fifth of the map, of a length whose first digit is 1, 2 or 5."""
    from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar

    fifth = terrain.heights.shape[1] * metres.dx / 5
    power = 10.0 ** math.floor(math.log10(fifth))
    length = max(power * digit for digit in (1, 2, 5) if power * digit <= fifth)
    degrees, unit = terrain.crs is not None and terrain.crs.degrees, terrain.georeference.unit if terrain.georeference else ""
    in_metres = degrees or unit.lower() in ("metre", "meter", "m")
    said = f"{length / 1000:g} km" if in_metres and length >= 1000 else f"{length:g} {'m' if in_metres else unit}".rstrip()
    drawn = length * terrain.dx / metres.dx
    bar = AnchoredSizeBar(axis.transData, drawn, said, "lower left", pad=0.4, borderpad=0.6, sep=3, frameon=True)
    bar.patch.set(alpha=0.7, linewidth=0)
    axis.add_artist(bar)


def _draw_north(axis: Any, turned: float) -> None:
    """An arrow to true north, which stands counterclockwise of y where y is turned clockwise of it, degrees."""
    east, north = -math.sin(math.radians(turned)), math.cos(math.radians(turned))
    axis.annotate(
        "N", xy=(0.96, 0.97), xycoords="axes fraction", xytext=(-32 * east, -32 * north), textcoords="offset points",
        ha="center", va="center", weight="bold", arrowprops={"arrowstyle": "-|>", "facecolor": "k"},
        bbox={"boxstyle": "circle,pad=0.15", "facecolor": "w", "alpha": 0.7, "linewidth": 0},
    )  # fmt: skip
