"""A fit on one page: its heights, how sure they are, its pictures beside the measured ones, and how it got there."""

import base64
import html
import io
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ..fitting.model.unknowns import differences, sun
from ..fitting.trust.judge import Fit
from ..io.scenes.toml.fit import Case
from ..scene.heightfield import Heightfield

_FAR = 4  # standard deviations at which the colours of residuals end
_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<style>body {{ font: 16px/1.5 sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em }}
img {{ max-width: 100% }} th {{ text-align: left; padding-right: 2em; font-weight: normal; color: #555 }}</style></head>
<body><h1>{title}</h1>
<table>{facts}</table>
{figures}</body></html>
"""


def report(title: str, case: Case, found: Fit) -> str:
    """An HTML page that needs no other file; its plots are matplotlib's."""
    rows = [*_summary(case, found), *facts(case, found)]
    table = "".join(f"<tr><th>{name}</th><td>{html.escape(text)}</td></tr>" for name, text in rows)
    figures = (
        ("Heights", _heights(found, case.scenes[0].heightfields[0])),
        ("Pictures", _pictures(found, case.targets, case.names)),
        ("Convergence", _convergence(found)),
    )
    shown = "".join(f'<h2>{name}</h2><img alt="{name}" src="{_embedded(figure)}">\n' for name, figure in figures)
    return _PAGE.format(title=html.escape(title), facts=table, figures=shown)


def facts(case: Case, found: Fit) -> Iterator[tuple[str, str]]:
    """What was sought beside the heights, by its name: noise, exposure, light and camera of each picture."""
    if case.noise is None:
        yield "noise, estimated", _listed(found.noise, 3)
    for name, values in (("exposures", found.exposures), ("offsets", found.offsets)):
        if values is not None:
            yield name, _listed(values, 6)
    if sought := case.unknown.get("material_std"):
        material = found.scenes[0].objects[found.scenes[0].first_heightfield].material
        yield "material", ", ".join(f"{name} {float(getattr(material, name)):.4g}" for name in sought)
    lights, cameras = [], []
    for given, scene in zip(case.scenes, found.scenes, strict=True):
        turned, moved, rotated = differences(given, scene)
        light = sun(scene.lights)
        if light is not None:
            x, y, z = np.asarray(light.towards, np.float64)
            azimuth, altitude = np.degrees(np.arctan2(x, y)) % 360, np.degrees(np.arctan2(z, np.hypot(x, y)))
            lights.append(f"azimuth {azimuth:.2f} altitude {altitude:.2f} (turned by {turned:.2f} degrees)")
        eye = " ".join(f"{value:.9g}" for value in np.asarray(scene.camera.world_from_camera)[:3, 3])
        cameras.append(f"eye {eye} (moved by {moved:.4g}, turned by {rotated:.2f} degrees)")
    for name, texts in (("light", lights), ("camera", cameras)):
        if f"{name}_std" in case.unknown:
            yield name, ", ".join(texts)


def _summary(case: Case, found: Fit) -> Iterator[tuple[str, str]]:
    ny, nx = found.heights.shape
    heights, stats = np.asarray(found.heights), found.stats
    yield "result", found.result.value
    yield "heights", f"{ny} x {nx}, from {heights.min():.6g} to {heights.max():.6g}; {int((~found.seen).sum())} not seen"
    yield "steps", f"{stats['steps']}, {stats['accepted']} of them accepted"
    yield "seconds", f"{stats['seconds']:.1f}"
    yield "loss", f"{stats['loss']:.6g}"
    yield "χ² of a pixel", f"{stats['chi2']:.4g} (about 1 where the noise is right and all is explained)"
    if case.noise is not None:
        yield "noise", _listed(found.noise, 3)
    yield from (("warning", warning) for warning in found.warnings)
    if found.std is not None:
        yield "standard deviation", f"{np.median(found.std):.3g} (median)"
    if found.albedo is not None:
        yield "albedo, mean factor", _listed(np.asarray(found.albedo).mean(axis=(0, 1)), 5)


def _listed(values: Any, digits: int) -> str:
    return ", ".join(f"{float(value):.{digits}g}" for value in values)


def _figure(rows: int, columns: int, height: float) -> tuple[Any, np.ndarray]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _heights(found: Fit, field: Heightfield) -> Any:
    from matplotlib.colors import LightSource

    heights, start = np.asarray(found.heights, np.float64), np.asarray(field.heights, np.float64)
    ny, nx = heights.shape
    # Each height is shown as the rectangle round its vertex.
    extent = (
        field.x0 - field.dx / 2, field.x0 + (nx - 0.5) * field.dx,
        field.y0 - field.dy / 2, field.y0 + (ny - 0.5) * field.dy,
    )  # fmt: skip
    # Rows grow to the north, for which matplotlib takes a negative spacing.
    relief = LightSource(315, 45).hillshade(heights, dx=field.dx, dy=-field.dy)
    span, most = {"vmin": heights.min(), "vmax": heights.max()}, float(np.abs(heights - start).max()) or 1.0
    panels: list[tuple[str, np.ndarray, dict[str, Any]]] = [
        ("found", heights, span),
        ("found, lit from the north-west", relief, {"cmap": "gray", "vmin": 0, "vmax": 1}),
        ("of the scene, before", start, span),
        ("found - before", heights - start, {"cmap": "RdBu_r", "vmin": -most, "vmax": most}),
    ]
    if found.std is not None:
        panels.append(("standard deviation", np.where(np.isfinite(found.std), found.std, np.nan), {"cmap": "magma"}))
    panels.append(("seen in a picture", found.seen.astype(float), {"cmap": "gray", "vmin": 0, "vmax": 1}))
    rows = -(-len(panels) // 2)
    figure, axes = _figure(rows, 2, 4.2 * rows)
    for axis in axes.flat[len(panels) :]:
        axis.set_axis_off()
    for axis, (name, values, style) in zip(axes.flat, panels, strict=False):
        shown = axis.imshow(values, origin="lower", extent=extent, **style)
        axis.set_title(name)
        axis.ticklabel_format(useOffset=False, style="plain")
        axis.tick_params(axis="x", labelrotation=30)
        if style.get("cmap") != "gray":
            figure.colorbar(shown, ax=axis)
    return figure


def _pictures(found: Fit, targets: Sequence[np.ndarray], names: Sequence[str]) -> Any:
    from matplotlib.patches import Rectangle

    height, width = targets[0].shape[:2]
    figure, axes = _figure(len(targets), 3, 10 / 3 * len(targets) * min(1.5, max(0.5, height / width)) + 0.5)
    for number, (row, target, image, residual, deviation, name) in enumerate(
        zip(axes, targets, found.images, found.residuals, found.noise, names, strict=True)
    ):
        top = float(np.nanmax(target)) or 1.0
        for axis, values, title in ((row[0], target, f"{name}, measured"), (row[1], image, "simulated")):
            axis.imshow(np.nan_to_num(np.clip(values / top, 0, 1)) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
            axis.set_title(title)
        far = residual if residual.ndim == 2 else residual.mean(axis=-1)
        shown = row[2].imshow(far / deviation, cmap="RdBu_r", vmin=-_FAR, vmax=_FAR)
        row[2].set_title("difference / noise, worst regions")
        figure.colorbar(shown, ax=row[2])
        for rank, region in enumerate(found.regions, 1):
            if region.picture == number:
                corner = region.column - 0.5, region.row - 0.5
                row[2].add_patch(Rectangle(corner, region.width, region.height, fill=False, edgecolor="k"))
                row[2].annotate(str(rank), corner, ha="right", va="bottom")
        for axis in row:
            axis.set_xticks([])
            axis.set_yticks([])
    return figure


def _convergence(found: Fit) -> Any:
    figure, axes = _figure(1, 2, 3.6)
    steps = [step for step in found.history if np.isfinite(step.loss)]
    for axis, at, name in ((axes[0, 0], "step", "step"), (axes[0, 1], "seconds", "seconds")):
        for level in sorted({step.level for step in steps}):
            chosen = [step for step in steps if step.level == level]
            positions, losses = [getattr(step, at) for step in chosen], [step.loss for step in chosen]
            (line,) = axis.plot(positions, losses, "-", label=f"{level} DCT modes a side")
            for accepted, marker in ((True, "o"), (False, "x")):
                kept = [k for k, step in enumerate(chosen) if step.accepted == accepted]
                axis.plot([positions[k] for k in kept], [losses[k] for k in kept], marker, ms=4, color=line.get_color())
        axis.set_yscale("log")
        axis.set_xlabel(name)
        axis.set_ylabel("loss")
    axes[0, 0].set_title("dots: accepted, crosses: not")
    if steps:
        axes[0, 0].legend()
    return figure


def _embedded(figure: Any) -> str:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=90, bbox_inches="tight")
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode()
