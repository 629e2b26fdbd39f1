"""What this machine can do: too many devices are refused, and pictures that do not fit into its memory."""

import argparse

import jax

from ..core.errors import UserError, counted
from ..scene.scene import Scene
from ..xla.machine import available_bytes, default_devices, usable_cores
from .cache import keep_programs

# Bytes in single precision. Measured at the peak: 57 to 65 for each height and device, 16 for each pixel with `exhausted`, 111
# while a .png is written (docs/guides/devices.md). Less than each is asked for, so that what might fit is tried.
_BYTES_A_HEIGHT = 45
_BYTES_A_PIXEL = 14
_BYTES_A_HEIGHT_OF = {"viewshed": 90, "insolation": 95, "skyview": 60, "horizon": 55}  # docs/measurements/maps.md


def set_up_jax(options: argparse.Namespace) -> None:
    """Configures JAX by the options of the machine, which can only be done before its first use."""
    require_devices(options.devices)
    jax.config.update("jax_enable_x64", options.precision == "float64")
    jax.config.update("jax_num_cpu_devices", options.devices or default_devices())
    keep_programs(options.cache)


def require_devices(devices: int | None) -> None:
    """UserError where there are more devices than could ever pay; None: those of `default_devices`."""
    most = max(16, usable_cores())
    if devices is not None and not 1 <= devices <= most:
        raise UserError(
            f"--devices must be a whole number from 1 to {most}, it is {devices}; {default_devices()} are best here"
        )


def require_memory(scene: Scene, devices: int) -> None:
    """UserError where a picture of this scene certainly needs more memory than there is."""
    width, height = scene.camera.width, scene.camera.height
    heights = sum(field.heights.size for field in scene.heightfields)
    single = scene.heights.dtype.itemsize / 4 if scene.heightfields else 1
    _require_free(
        single * (_BYTES_A_HEIGHT * heights * devices + _BYTES_A_PIXEL * width * height),
        f"{width} x {height} pixels of {heights} heights",
        f" on {counted(devices, 'device')}",
        "a smaller picture or terrain, or fewer --devices, take less",
    )


def require_memory_of_map(command: str, heights: int, precision: str, maps: int = 0) -> None:
    """UserError where a map by JAX of so many heights certainly needs more memory than there is; `maps`: how many are kept to
    be written into one file, where they stand once more."""
    needed = (_BYTES_A_HEIGHT_OF[command] + 8 * maps) * heights * (2 if precision == "float64" else 1)
    _require_free(needed, f"{command}: {heights} heights", "", "--bbox takes a part")


def _require_free(needed: float | int, what: str, where: str, hint: str) -> None:
    available = available_bytes()
    if needed > available:
        free = f"{available / 1e9:.3g} GB are free"
        raise UserError(f"{what} take more than {needed / 1e9:.3g} GB of memory{where}, {free}; {hint}")
