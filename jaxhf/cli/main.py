"""The command line. JAX is imported only when a command runs."""

import argparse
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NoReturn

from ..core.errors import UserError
from ..core.version import __version__

if TYPE_CHECKING:
    from ..core.settings import Settings
    from ..scene.scene import Scene


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; returns its exit code: 0, 2 after an error of the user's, 130 after Ctrl-C."""
    options = _parser().parse_args(arguments)
    try:
        options.run(options)
    except KeyboardInterrupt as interruption:
        print(f"\njaxhf: {str(interruption) or 'interrupted'}", file=sys.stderr)
        return 130
    except (UserError, OSError) as error:
        print(f"jaxhf: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED" not in str(error):  # which is what JAX calls it
            raise
        print(
            "jaxhf: error: memory ran out; a smaller picture or terrain needs less (render: also a smaller --chunk)",
            file=sys.stderr,
        )
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="jaxhf", description="Renders heightfields, and recovers them from pictures.")
    parser.add_argument("--version", action="version", version=f"jaxhf {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    render = commands.add_parser("render", help="render a scene to a picture", description="Render a scene to a picture.")
    render.add_argument("scene", metavar="SCENE", help="a .toml or .pbrt scene")
    render.add_argument(
        "-o", "--output", required=True, metavar="OUT", help="the picture: .png (sRGB), .exr, .npy or .pfm (linear)"
    )
    render.add_argument(
        "--width", type=int, metavar="PIXELS", help="size; with one of the two, the other keeps the scene's proportions"
    )
    render.add_argument("--height", type=int, metavar="PIXELS")
    render.add_argument("--samples", type=int, metavar="N", help="rays a pixel, a square number [the scene's, rounded up]")
    render.add_argument("--traversal", metavar="WALK", help="how hits are searched for: pyramid or dda [pyramid]")
    render.add_argument("--shading", help="smooth or flat [smooth]")
    render.add_argument("--normals", help="central, four, six, six-angle or six-equal [six]")
    render.add_argument("--no-shadows", dest="shadows", action="store_false", default=None, help="let light through everything")
    render.add_argument("--max-depth", type=int, metavar="N", help="mirror bounces [4]")
    render.add_argument("--max-steps", type=int, metavar="N", help="step budget of a walk [as many as any ray needs]")
    render.add_argument("--chunk", type=int, metavar="RAYS", help="rays traced together [1024]")
    _add_machine(render)
    render.set_defaults(run=_render)

    fit = commands.add_parser("fit", help="recover heights from pictures", description="Recover heights from pictures.")
    fit.add_argument("case", metavar="CASE", help="a .toml file: a scene, its pictures, and what is known")
    fit.add_argument("-o", "--output", required=True, metavar="OUT", help="the heights: .npy, .npz or .tif")
    fit.add_argument("--report", metavar="PAGE", help="an .html page with plots of heights, pictures and convergence")
    fit.add_argument("--resume", action="store_true", help="go on from OUT.checkpoint, if it is there")
    _add_machine(fit)
    fit.set_defaults(run=_fit)

    _add_hillshade(commands)

    convert = commands.add_parser(
        "convert", help="write a terrain in another format",
        description="Write a terrain in another format. From GeoTIFF to GeoTIFF it keeps its place on the map.",
    )  # fmt: skip
    convert.add_argument("terrain", metavar="IN", help="heights: .npy, .npz, .png (16 bits) or .tif")
    convert.add_argument("output", metavar="OUT", help=".npy, .npz or .tif")
    _add_stored(convert)
    convert.set_defaults(run=_convert)

    info = commands.add_parser("info", help="print what a scene holds", description="Print what a scene holds.")
    info.add_argument("scene", metavar="SCENE", help="a .toml or .pbrt scene")
    info.set_defaults(run=_info)
    _add_tradeoff(commands)
    return parser


def _add_hillshade(commands: Any) -> None:
    about = "Draw a shaded map: the terrain from straight above, north up, a pixel for each cell."
    hillshade = commands.add_parser("hillshade", help="draw a shaded map of a terrain", description=about)
    hillshade.add_argument("terrain", metavar="TERRAIN", help="heights: .npy, .npz, .png (16 bits) or .tif")
    hillshade.add_argument(
        "-o", "--output", required=True, metavar="OUT", help="the picture: .png (bytes in proportion), .exr, .npy or .pfm"
    )
    hillshade.add_argument(
        "--azimuth", type=float, default=315.0, metavar="DEGREES", help="of the light, from north, clockwise [315]"
    )
    hillshade.add_argument(
        "--altitude", type=float, default=45.0, metavar="DEGREES", help="of the light, above the horizon [45]"
    )
    hillshade.add_argument(
        "--sky", type=float, default=0.0, metavar="RADIANCE", help="light from everywhere, also seen through holes [0]"
    )
    hillshade.add_argument(
        "--no-shadows", dest="shadows", action="store_false", default=None, help="shade slopes, cast no shadows"
    )
    hillshade.add_argument("--width", type=int, metavar="PIXELS", help="size; with one of the two, the other keeps proportions")
    hillshade.add_argument("--height", type=int, metavar="PIXELS")
    hillshade.add_argument("--samples", type=int, metavar="N", help="rays a pixel, a square number [1]")
    _add_stored(hillshade)
    _add_machine(hillshade)
    hillshade.set_defaults(run=_hillshade)


def _add_stored(command: argparse.ArgumentParser) -> None:
    command.add_argument("--z-scale", type=float, default=1.0, metavar="S", help="heights are multiplied by it [1]")
    command.add_argument("--nodata", type=float, metavar="V", help="a stored value that means no height [as the file says]")


def _add_tradeoff(commands: Any) -> None:
    about = (
        "Sweep each setting over a scene: error against a reference in double precision, time, compilation and peak memory; "
        "print which settings nothing beats, and keep a table and a plot. What was measured is kept: the same command goes on "
        "after Ctrl-C, and only prints when all is there. It says how long it will take."
    )
    tradeoff = commands.add_parser("tradeoff", help="measure what each setting costs and gains", description=about)
    tradeoff.add_argument("scene", metavar="SCENE", help="a .toml or .pbrt scene")
    tradeoff.add_argument("-o", "--output", metavar="FOLDER", help="for table, reference and plot [NAME-tradeoff]")
    tradeoff.add_argument("--error", type=float, metavar="E", help="recommend the cheapest settings within this error")
    tradeoff.add_argument("--time", type=float, metavar="SECONDS", help="recommend the most exact settings within this time")
    tradeoff.add_argument("--quick", action="store_true", help="fewer values, a smaller picture, a coarser reference")
    tradeoff.add_argument("--fit", action="store_true", help="sweep tolerance and levels of a small fit, too")
    tradeoff.add_argument("--knobs", nargs="+", default=(), metavar="KNOB", help="sweep only these")
    tradeoff.add_argument("--width", type=int, metavar="PIXELS", help="size [the scene's, at most 480 for the longer side]")
    tradeoff.add_argument("--devices", type=int, metavar="N", help="cores that share the work [all, at most 16]")
    tradeoff.add_argument("--repeats", type=int, default=5, metavar="N", help="runs whose median is taken [5]")
    tradeoff.add_argument("--markdown", action="store_true", help="print all figures as tables")
    tradeoff.set_defaults(run=_tradeoff)


def _add_machine(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--devices", type=int, metavar="N", help="cores that share the work, each with a copy [all, at most 16]"
    )
    command.add_argument("--precision", choices=("float32", "float64"), default="float32", help="[float32]")


def _render(options: argparse.Namespace) -> None:
    _draw(options, lambda: _resized(_load(options.scene, options.precision), options.width, options.height))


def _hillshade(options: argparse.Namespace) -> None:
    from ..io.load_terrain import load_heights
    from .hillshade import hillshade_scene, printed

    def scene() -> "Scene":
        terrain = load_heights(options.terrain, z_scale=options.z_scale, nodata=options.nodata)
        terrain = replace(terrain, heights=terrain.heights.astype(options.precision))
        _require_size(options.width, options.height)
        size = options.width, options.height
        return hillshade_scene(terrain, options.azimuth, options.altitude, options.sky, *size)

    _draw(options, scene, printed if options.output.lower().endswith(".png") else None)


def _draw(options: argparse.Namespace, load: "Callable[[], Scene]", tone: Callable[[Any], Any] | None = None) -> None:
    from ..io.images import require_writable, save_image

    require_writable(options.output)
    settings = _settings(options)
    _set_up_jax(options.precision, options.devices)
    image, report = _timed_render(load(), settings)
    save_image(options.output, tone(image) if tone else image)
    print(f"{options.output}: {report}")


def _convert(options: argparse.Namespace) -> None:
    from pathlib import Path

    from ..io.load_terrain import load_heights
    from ..io.save_terrain import require_writable_heights, save_heights
    from .info import heightfield_line

    require_writable_heights(options.output)
    terrain = load_heights(options.terrain, z_scale=options.z_scale, nodata=options.nodata)
    rasters = {Path(path).suffix.lower() for path in (options.terrain, options.output)} <= {".tif", ".tiff"}
    save_heights(options.output, terrain, options.terrain if rasters else None)
    alone = " (.npy holds the heights alone)" if Path(options.output).suffix.lower() == ".npy" else ""
    print(f"{options.output}: {heightfield_line(terrain)}{alone}")


def _fit(options: argparse.Namespace) -> None:
    from pathlib import Path

    from .fit import Outputs, fit_file

    outputs = Outputs(Path(options.output), Path(options.report) if options.report else None, options.resume)
    _set_up_jax(options.precision, options.devices)
    print(fit_file(options.case, outputs, options.precision))


def _set_up_jax(precision: str, devices: int | None) -> None:
    """What can only be said before JAX is first used."""
    import jax

    from ..core.machine import default_devices

    if devices is not None and devices < 1:
        raise UserError(f"--devices must be a whole number from 1 on, it is {devices}")
    jax.config.update("jax_enable_x64", precision == "float64")
    jax.config.update("jax_num_cpu_devices", devices or default_devices())


def _settings(options: argparse.Namespace) -> "Settings":
    from ..core.settings import Settings

    names = ("samples", "traversal", "shading", "normals", "shadows", "max_depth", "max_steps", "chunk")
    return Settings(**{name: getattr(options, name) for name in names if getattr(options, name, None) is not None})


def _load(path: str, precision: str) -> "Scene":
    import numpy as np

    from ..io.scenes import load_scene

    return load_scene(path, np.dtype(precision))


def _require_size(width: int | None, height: int | None) -> None:
    for name, value in (("width", width), ("height", height)):
        if value is not None and value < 1:
            raise UserError(f"--{name} must be a whole number of pixels from 1 on, it is {value}")


def _resized(scene: "Scene", width: int | None, height: int | None) -> "Scene":
    old = scene.camera
    _require_size(width, height)
    if width is None and height is None:
        return scene
    if width is None:
        width = max(1, round((height or 1) * old.width / old.height))
    elif height is None:
        height = max(1, round(width * old.height / old.width))
    return replace(scene, camera=replace(old, width=width, height=height))


def _timed_render(scene: "Scene", settings: "Settings") -> tuple[Any, str]:
    import jax
    import numpy as np

    from ..rendering.render import render
    from ..trace.world import resolve_settings

    compiling = _CompileTime()
    begin = time.perf_counter()
    with _Progress() as progress:
        image, aovs = render(scene, settings, aovs=("exhausted",), progress=progress)
    elapsed = time.perf_counter() - begin
    seconds = max(elapsed - compiling.seconds, 1e-9)
    samples = resolve_settings(settings, scene).samples or 1
    height, width = image.shape[:2]
    rays = height * width * samples
    return image, (
        f"{width} x {height} pixels, {rays} camera rays ({samples} a pixel), "
        f"{seconds:.3g} s + {compiling.seconds:.3g} s compiling, "
        f"{jax.local_device_count()} x {jax.devices()[0].device_kind}, {rays / seconds:.3g} rays/s, "
        f"{int(np.sum(aovs['exhausted']))} rays exhausted"
    )


class _CompileTime:
    """Adds up the seconds that JAX spends on tracing and compiling from now on."""

    def __init__(self) -> None:
        import jax

        self.seconds = 0.0
        jax.monitoring.register_event_duration_secs_listener(self._add)

    def _add(self, event: str, duration_secs: float, **_: Any) -> None:
        if event.startswith("/jax/core/compile/"):
            self.seconds += duration_secs


class _Progress:
    """A line that grows with the picture, on a terminal only, and not for what is done in half a second."""

    def __init__(self) -> None:
        self.begin = time.perf_counter()
        self.shown = False

    def __enter__(self) -> "_Progress":
        return self

    def __call__(self, done: int, total: int) -> None:
        elapsed = time.perf_counter() - self.begin
        if not sys.stderr.isatty() or elapsed < 0.5:
            return
        self.shown = True
        left = elapsed * (total - done) / max(done, 1)
        print(
            f"\r{100 * done // total:3d} % of {total} pixels, {elapsed:.0f} s, {left:.0f} s left ",
            end="",
            file=sys.stderr,
            flush=True,
        )

    def __exit__(self, *_: object) -> None:
        if self.shown:
            print("\r" + " " * 70 + "\r", end="", file=sys.stderr, flush=True)


def _info(options: argparse.Namespace) -> None:
    from .info import scene_lines

    scene = _load(options.scene, "float32")
    print(f"{options.scene}: {scene.camera.width} x {scene.camera.height} pixels, {scene.samples} samples a pixel")
    print("\n".join(scene_lines(scene)))


def _tradeoff(options: argparse.Namespace) -> None:
    from ..core.extras import import_extra
    from ..study.pareto import front_lines, markdown, recommend
    from ..study.plan import plan
    from ..study.plots import save_plot
    from ..study.sweep import run

    for name in ("error", "time", "repeats"):
        value = getattr(options, name)
        if value is not None and not value > 0:
            raise UserError(f"--{name} must be positive, it is {value}")
    import_extra("matplotlib", "tradeoff draws with", "plot")
    sweep = plan(
        options.scene, options.output, width=options.width, devices=options.devices, knobs=options.knobs, quick=options.quick,
        fits=options.fit,
    )  # fmt: skip
    with _Counter() as counter:
        failures = run(sweep, options.repeats, counter.tell, counter)
    measured = sweep.measured()
    if failures:
        print("\n".join(f"failed: {failure}" for failure in failures), file=sys.stderr)
    if not measured:
        raise UserError(f"{sweep.path}: nothing could be measured")
    plot = save_plot(sweep, measured)
    asks = options.error is not None or options.time is not None
    if options.markdown:
        print(markdown(measured), end="\n\n")
    if asks or not options.markdown:
        print("\n".join(recommend(measured, options.error, options.time) if asks else front_lines(measured)))
    print(f"{len(measured)} configurations: {sweep.table}, {plot}")
    if failures:
        raise UserError(f"{len(failures)} configurations failed")


class _Counter:
    """What a sweep is at, on a terminal only."""

    def __call__(self, done: int, total: int, what: str) -> None:
        if sys.stderr.isatty():
            line = f"{done}/{total} {what}"[: shutil.get_terminal_size().columns - 1]  # longer ones would stay
            print(f"\r\033[K{line}", end="", file=sys.stderr, flush=True)

    def tell(self, line: str) -> None:
        self._clear()
        print(line, file=sys.stderr, flush=True)  # what is printed else may be a table on its way into a file

    def _clear(self) -> None:
        if sys.stderr.isatty():
            print("\r\033[K", end="", file=sys.stderr, flush=True)

    def __enter__(self) -> "_Counter":
        return self

    def __exit__(self, *_: object) -> None:
        self._clear()
