"""A picture in perspective with what explains it: a title and a caption, a scale bar and north; by matplotlib."""

import math
import textwrap
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from ..io.terrain.georeference import Georeference
from ..io.terrain.terrain import Terrain
from ..scene.camera import Perspective
from .sheet import DPI, draw_north, scale_of


def annotated(
    image: UInt8[np.ndarray, "h w 3"], terrain: Terrain, camera: Perspective, level: float, title: str | None, caption: str
) -> Any:
    """A picture, pixel by pixel, over its title and caption, as a figure of matplotlib's.

    `camera` sees the terrain with vertex (0, 0) at x = y = 0, and its lowest parts at this level. The scale bar is as long as
    lengths on an edge there, and the arrow shows how north runs in the middle.
    """
    from matplotlib.figure import Figure

    height, width, _ = image.shape
    size = max(12.0, width / 80)  # of letters, pixels
    span = (np.array(terrain.heights.shape[::-1]) - 1) * (terrain.dx, terrain.dy)
    bar, away, said = _edge_bar(camera, span, level, terrain.georeference or Georeference())
    bar, label = bar + 0.6 * size * away, bar.mean(0) + 1.5 * size * away
    texts = (title or "", 1.35 * size, "k"), (caption, size, "0.3")
    lines = [
        (line, each, colour) for text, each, colour in texts for line in textwrap.wrap(text, max(int(1.6 * width / each), 1))
    ]
    y = max(0.5 * size, label[1] + size - height)  # of the uppermost line, below the picture
    strip = math.ceil(y + sum(1.4 * each for _, each, _ in lines) + 0.5 * size)
    figure = Figure(figsize=(width / DPI, (height + strip) / DPI), dpi=DPI)
    axis = figure.add_axes((0, strip / (height + strip), 1, height / (height + strip)), xlim=(0, width), ylim=(height, 0))
    axis.set_axis_off()
    axis.imshow(image, extent=(0, width, height, 0), aspect="auto", interpolation="none")
    for line, each, colour in lines:
        how = {"size": each * 72 / DPI, "color": colour, "va": "top", "parse_math": False}
        figure.text(size / width, (strip - y) / (height + strip), line, **how)
        y += 1.4 * each
    axis.plot(*bar.T, color="0.1", linewidth=0.15 * size * 72 / DPI, solid_capstyle="butt", clip_on=False)
    x, y = bar[1] - bar[0]
    turn = (math.degrees(math.atan2(-y, x)) + 90) % 180 - 90  # so that it can be read
    how = {"size": 0.9 * size * 72 / DPI, "ha": "center", "va": "center", "rotation_mode": "anchor", "color": "0.1"}
    axis.text(label[0], label[1], said, rotation=turn, parse_math=False, **how)
    north = math.radians(terrain.turned_from_north)
    step = 1e-3 * span.min() * np.array([-math.sin(north), math.cos(north)])
    tail, head = camera.project([(*(span / 2 + sign * step), level) for sign in (-1, 1)])
    right, up = (head - tail) / max(np.hypot(*(head - tail)), 1e-9) * (1, -1)
    tip = 1 - (4 - 1.5 * np.array([right, up])) * size / np.array([width, height])
    draw_north(axis, math.degrees(math.atan2(-right, up)), tip, 3 * size * 72 / DPI)
    return figure


def _edge_bar(
    camera: Perspective, span: np.ndarray, level: float, place: Georeference
) -> tuple[Float[np.ndarray, "2 2"], Float[np.ndarray, "2"], str]:
    """The ends of a scale bar in the middle of an edge of a terrain, pixels; the direction away from it there; its length.

    Of the edges of this span, at this level, it is the one that faces the camera and looks longest.
    """
    edges = np.array([((0, 0), (1, 0)), ((1, 0), (1, 1)), ((1, 1), (0, 1)), ((0, 1), (0, 0))]) * span
    outwards = np.array([(0, -1), (1, 0), (0, 1), (-1, 0)])
    eye = np.asarray(camera.world_from_camera, np.float64)[:2, 3]
    facing = ((eye - edges[:, 0]) * outwards).sum(1) > 0  # others may be hidden; from above there is none
    seen = camera.project(np.insert(edges, 2, level, axis=-1))
    k = np.argmax(np.linalg.norm(seen[:, 1] - seen[:, 0], axis=1) * (facing | ~facing.any()))
    along = edges[k, 1] - edges[k, 0]
    length, said = scale_of(float(np.linalg.norm(along)) / 3, place)
    ends = edges[k].mean(0) + np.array([[-0.5], [0.5]]) * length * along / np.linalg.norm(along)
    bar = camera.project(np.insert(ends, 2, level, axis=-1))
    x, y = (bar[1] - bar[0]) / max(np.hypot(*(bar[1] - bar[0])), 1e-9)
    away = np.array([-y, x]) * (1 if np.dot((-y, x), bar.mean(0) - seen.mean((0, 1))) >= 0 else -1)
    return bar, away, said
