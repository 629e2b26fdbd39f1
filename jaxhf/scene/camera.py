"""Cameras: from a point of the picture to a ray in the world, and back."""

import dataclasses
import functools
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.affine import affine, invertible
from ..core.errors import whole_number
from ..core.ray import Ray
from ..core.rules import OneOf, Whole, require
from ..core.types import ANGLE_OF_VIEW, FINITE, POSITIVE, AnyArray, MatrixLeaf, Scalar, ScalarLeaf, float_leaf
from ..core.vector import dot, unit
from .framing import framing_pose
from .heightfield import Heightfield
from .mapped import geotransformed, resected_rpc
from .pose import look_at_pose, require_pose
from .projection import Projection, film, projected, screen
from .record import Record, known, numbers
from .resection import resected, resected_in_parallel

Convention = Literal["opencv", "opengl"]
_PIXELS = Whole(1, unit="pixels")  # along a side of a picture


class Perspective(Record):
    """A pinhole camera.

    Attributes:
      world_from_camera: 4x4; camera space is +x right, +y up, +z forward (the handedness of pbrt). What is not a rotation in
        it stretches and shears the picture: so `from_intrinsics` takes account of a principal point off the centre.
      fov: full angle of view across the shorter side of the picture, degrees.
      width, height: of the picture, pixels.
    """

    world_from_camera: MatrixLeaf = eqx.field(converter=float_leaf, metadata={"rule": invertible})
    fov: ScalarLeaf = eqx.field(converter=float_leaf, default=45.0, metadata={"rule": ANGLE_OF_VIEW})
    width: int = eqx.field(converter=whole_number, static=True, default=512, metadata={"rule": _PIXELS})
    height: int = eqx.field(converter=whole_number, static=True, default=512, metadata={"rule": _PIXELS})
    _ahead: ScalarLeaf | None = eqx.field(default=None, kw_only=True)  # see `localise_camera`
    _size: Float[AnyArray, "2"] | None = eqx.field(default=None, kw_only=True)  # see `of_any_size`

    @classmethod
    def look_at(
        cls, eye: Any, target: Any, up: Any = (0, 0, 1), fov: Any = 45.0, *, width: int = 512, height: int = 512
    ) -> "Perspective":
        """A camera at `eye` that looks at `target`, in a right-handed world.

        Args:
          eye, target: two points, world units.
          up: a direction that is up in the picture; not that of the view, so (0, 1, 0) for one from straight above.
          fov, width, height: as for the class.

        Raises:
          ValueError: the three leave no frame, or a number is out of range.
        """
        return cls(look_at_pose(eye, target, up), fov, width=width, height=height)

    @classmethod
    def from_intrinsics(
        cls,
        fx: Any,
        fy: Any,
        cx: Any,
        cy: Any,
        *,
        world_from_camera: Any,
        width: int,
        height: int,
        convention: Convention | str = "opencv",
    ) -> "Perspective":
        """The camera of a calibration: a pinhole without distortion, and its pose.

        Args:
          fx, fy: focal lengths, in widths and in heights of a pixel.
          cx, cy: the principal point, pixels from the picture's top left corner: right and, in both conventions, down. The
            centre of the top left pixel is (0.5, 0.5) here. OpenCV and what is calibrated with it call that point (0, 0): add
            0.5 to both numbers.
          world_from_camera: 4x4, a rotation and the position of the eye: [R | t] of OpenCV or COLMAP, which maps the world to
            the camera, must be inverted.
          width, height: of the picture for which the numbers hold, pixels.
          convention: of the camera's axes: "opencv" (COLMAP, ROS), +x right, +y down, +z forward; "opengl" (Blender, NeRF), +x
            right, +y up, the view along -z.

        Raises:
          ValueError: focal lengths that are not positive, a matrix that is no pose, an unknown convention.
        """
        require("from_intrinsics", "convention", convention, OneOf(Convention))
        require_size("from_intrinsics", width, height)
        lens = {"fx": float_leaf(fx), "fy": float_leaf(fy), "cx": float_leaf(cx), "cy": float_leaf(cy)}
        for name, leaf in lens.items():
            require("from_intrinsics", name, leaf, POSITIVE if name in ("fx", "fy") else FINITE)
        pose = float_leaf(world_from_camera)
        require_pose(pose)
        leaves, xp = [pose, *lens.values()], np
        if traced := [leaf.dtype for leaf in leaves if isinstance(leaf, jax.Array)]:
            leaves, xp = [jnp.asarray(leaf, jnp.result_type(*traced)) for leaf in leaves], jnp
        pose, fx, fy, cx, cy = leaves
        side = 1 if convention == "opengl" else -1
        right, up, backward = pose[:3, 0], side * pose[:3, 1], side * pose[:3, 2]
        # Rays go along column 2 + sx tan(fov / 2) column 0 + sy tan(fov / 2) column 1, see `screen`.
        f = fx if width <= height else fy
        middle = right * ((width / 2 - cx) / fx) + up * ((cy - height / 2) / fy) - backward
        columns = xp.stack([right * (f / fx), up * (f / fy), middle, pose[:3, 3]], axis=1)
        fov = xp.rad2deg(2 * xp.arctan(min(width, height) / 2 / f))
        return cls(xp.concatenate([columns, pose[3:]]), fov, width=width, height=height)

    @classmethod
    def from_points(cls, points: Any, pixels: Any, *, width: int, height: int, max_error: float | int = 1.0) -> "Perspective":
        """The camera that sees known points at known pixels: a pinhole's resection, by least squares in double precision.

        It takes all that a pinhole may be, in 11 numbers: place, direction, focal length, principal point, pixels that are not
        square or skew. So `world_from_camera` may be no rotation.

        Args:
          points: (n, 3), at least 6 and better 20, world units, not all in one plane: as high and as low as what is to be seen.
          pixels: (n, 2), where each is seen: right and down from the picture's top left corner. The centre of the top left
            pixel is (0.5, 0.5) here, which OpenCV calls (0, 0): add 0.5 to its numbers. Without distortion.
          width, height: of the picture, pixels.
          max_error: how far a pixel may be from where the camera sees its point; it tells pixels that are another point's.
            The distances are those of `camera.project(points)` from `pixels`.

        Raises:
          ValueError: a pixel is farther off; points are too few, in a plane, behind the camera or so far away that rays are
            parallel; pixels are on a line or mirrored; a number is not finite or is traced.
        """
        require_size("from_points", width, height)
        return cls(*resected(points, pixels, width, height, max_error), width=width, height=height)

    @classmethod
    def from_rpc(
        cls, rpcs: Any, terrain: Any, *, width: int, height: int, geoid: float | int = 0.0, max_error: float | int = 0.05
    ) -> "Perspective":
        """The pinhole that sees a terrain where the RPC model of a satellite's picture does (NIMA, STDI-0002, 2000, RPC00B).

        It is fitted to GDAL's transformer in a box around that part of the terrain which is in the picture. A scanner that
        builds its picture line by line is no pinhole: the error grows with the square of that part's width.

        Args:
          rpcs: rasterio's `dataset.rpcs`. For a window of the picture, subtract its first column from `samp_off` and its first
            row from `line_off`; gdal_translate does so.
          terrain: a `Terrain` with a reference system, as `load_heights` gives it. Needs rasterio.
          width, height: of the picture, pixels.
          geoid: what is added to the terrain's heights, metres. The model's heights count from the ellipsoid; most elevation
            models' from the geoid, whose height above the ellipsoid this is then, -106 to 85 on the Earth.
          max_error: how far the camera may be off in the box, pixels.

        Raises:
          ValueError: one camera is farther off, the terrain is not in the picture or has no place on a globe, or `rpcs` are
            none of rasterio's.
        """
        require_size("from_rpc", width, height)
        return cls(*resected_rpc(rpcs, terrain, width, height, geoid, max_error), width=width, height=height)

    @classmethod
    def framing(
        cls,
        field: Heightfield,
        azimuth: float = 135.0,
        altitude: float = 30.0,
        fov: float = 30.0,
        *,
        width: int = 512,
        height: int = 512,
        margin: float = 0.05,
        base: float | None = None,
        around: bool = False,
    ) -> "Perspective":
        """The nearest camera that has all of a heightfield in its picture.

        Args:
          field: what is to be seen, in the world's frame, with its heights known (not traced).
          azimuth: where the camera stands as seen from the terrain, degrees clockwise from north (+y): 135 is south-east.
          altitude: of the camera above the horizon, as seen from the terrain, degrees.
          fov: full angle of view across the shorter side, degrees.
          width, height: of the picture, pixels.
          margin: the share of the picture that stays empty at each border at least.
          base: the level of a `Skirt`'s floor, which is to be seen, too; None: there is none.
          around: for a camera that is to go round the terrain: from every azimuth the distance is the same, and suffices.

        Raises:
          ValueError: angles out of range, or a terrain without heights.
        """
        require_size("framing", width, height)
        pose = framing_pose(field, azimuth, altitude, fov, width, height, margin, base, around)
        return cls(pose, fov, width=width, height=height)

    def ray(self, x: Scalar, y: Scalar) -> Ray:
        """The ray through the point (x, y) of the picture: pixels, from its top left corner; `d` has length 1."""
        world = affine(jnp.asarray(self.world_from_camera))
        sx, sy = screen(self, x, y)
        half = jnp.tan(jnp.deg2rad(jnp.asarray(self.fov)) / 2)
        along = world.vector(jnp.stack([sx * half, sy * half, jnp.ones_like(half)]))
        if self._ahead is None:
            return Ray(world.offset, unit(along))
        across = world.vector(jnp.stack([sx * half, sy * half, jnp.zeros_like(half)]))
        d = unit(along)
        return Ray(world.offset + self._ahead * across, d, self._ahead * dot(along, d))

    def film_from_world(self) -> Projection:
        """The projection of points in the world to pixels, the inverse of `ray`."""
        return film(self, jnp.tan(jnp.deg2rad(jnp.asarray(self.fov)) / 2), parallel=False)

    def project(self, points: Any) -> Float[np.ndarray, "*n 2"]:
        """Where points (..., 3) of the world are seen: (..., 2), pixels right and down from the top left corner.

        In double precision, of numbers that are not traced; nan where a point is not in front of the camera.
        """
        return projected(self, points, lambda depth: depth * np.tan(np.radians(np.asarray(self.fov, np.float64)) / 2))

    def viewpoint(self) -> tuple[Float[AnyArray, "3"], bool]:
        """The position of the eye, and True: it is a point."""
        world = affine(self.world_from_camera)
        return world.offset if self._ahead is None else world.offset - self._ahead * world.linear[:, 2], True

    def __repr__(self) -> str:
        return _shown(self, f"fov={numbers(self.fov)}")


class Orthographic(Record):
    """A camera whose rays are parallel.

    Attributes:
      world_from_camera: as for `Perspective`; rays start in the camera's plane z = 0.
      extent: what the shorter side of the picture spans, world units.
      width, height: of the picture, pixels.
    """

    world_from_camera: MatrixLeaf = eqx.field(converter=float_leaf, metadata={"rule": invertible})
    extent: ScalarLeaf = eqx.field(converter=float_leaf, default=1.0, metadata={"rule": POSITIVE})
    width: int = eqx.field(converter=whole_number, static=True, default=512, metadata={"rule": _PIXELS})
    height: int = eqx.field(converter=whole_number, static=True, default=512, metadata={"rule": _PIXELS})
    _ahead: ScalarLeaf | None = eqx.field(default=None, kw_only=True)  # see `localise_camera`
    _size: Float[AnyArray, "2"] | None = eqx.field(default=None, kw_only=True)  # see `of_any_size`

    @classmethod
    def look_at(
        cls, eye: Any, target: Any, up: Any = (0, 0, 1), extent: Any = 1.0, *, width: int = 512, height: int = 512
    ) -> "Orthographic":
        """A camera at `eye` that looks at `target`, as `Perspective.look_at`; `extent` as for the class."""
        return cls(look_at_pose(eye, target, up), extent, width=width, height=height)

    @classmethod
    def from_points(cls, points: Any, pixels: Any, *, width: int, height: int, max_error: float | int = 1.0) -> "Orthographic":
        """The camera that sees at least four known points at known pixels by parallel rays, which may be oblique.

        Arguments and errors are those of `Perspective.from_points`. For pictures from so far away that errors of pixels hide
        the perspective.
        """
        require_size("from_points", width, height)
        return cls(*resected_in_parallel(points, pixels, width, height, max_error), width=width, height=height)

    @classmethod
    def from_geotransform(cls, transform: Any, terrain: Any, *, width: int, height: int) -> "Orthographic":
        """The camera of an orthophoto: it looks straight down on a terrain, from above its highest point.

        Args:
          transform: rasterio's `dataset.transform`, from the picture's columns and rows to coordinates in the terrain's
            reference system; it may rotate, and pixels need not be square. GDAL's six numbers: `Affine.from_gdal(*numbers)`.
          terrain: a `Terrain`, as `load_heights` gives it, also one in degrees.
          width, height: of the picture, pixels.

        Raises:
          ValueError: `transform` is no Affine or flattens the picture, or the terrain has no heights.
        """
        require_size("from_geotransform", width, height)
        return cls(*geotransformed(transform, terrain, width, height), width=width, height=height)

    def ray(self, x: Scalar, y: Scalar) -> Ray:
        """The ray through the point (x, y) of the picture: pixels, from its top left corner; `d` has length 1."""
        world = affine(jnp.asarray(self.world_from_camera))
        sx, sy = screen(self, x, y)
        half = jnp.asarray(self.extent) / 2
        origin, d = world.point(jnp.stack([sx * half, sy * half, jnp.zeros_like(half)])), unit(world.linear[:, 2])
        return Ray(origin, d, None if self._ahead is None else self._ahead * dot(world.linear[:, 2], d))

    def film_from_world(self) -> Projection:
        """The projection of points in the world to pixels, the inverse of `ray`."""
        return film(self, jnp.asarray(self.extent) / 2, parallel=True)

    def project(self, points: Any) -> Float[np.ndarray, "*n 2"]:
        """Where points of the world are seen, as `Perspective.project`."""
        return projected(self, points, lambda depth: np.asarray(self.extent, np.float64) / 2)

    def viewpoint(self) -> tuple[Float[AnyArray, "3"], bool]:
        """The direction towards the eye, and False: it is infinitely far away."""
        return -affine(self.world_from_camera).linear[:, 2], False

    def __repr__(self) -> str:
        return _shown(self, f"extent={numbers(self.extent)}")


Camera = Perspective | Orthographic


def of_any_size(camera: Camera) -> Camera:
    """The same with its size as numbers, (width, height) in the dtype of its matrix, so that its programs serve all sizes."""
    size = np.array([camera.width, camera.height], camera.world_from_camera.dtype)
    return jax.tree.unflatten(_form_of_any_size(type(camera), camera._ahead is not None), [*jax.tree.leaves(camera), size])


@functools.cache
def _form_of_any_size(kind: type[Camera], far: bool) -> Any:
    ahead: Any = np.ones(()) if far else None
    size: Any = np.ones(2)
    return jax.tree.structure(kind(np.eye(4), width=1, height=1, _ahead=ahead, _size=size))


def cropped(camera: Camera, x: float | int, y: float | int, width: int, height: int) -> Camera:
    """The camera of `width` by `height` pixels of a picture from column x and row y on; its matrix may be no rotation."""
    matrix = np.array(camera.world_from_camera, np.float64)
    sx, sy = screen(camera, x + width / 2, y + height / 2)
    times = min(width, height) / min(camera.width, camera.height)
    if isinstance(camera, Perspective):
        half, moved = np.tan(np.radians(np.asarray(camera.fov, np.float64)) / 2), 2
        lens = {"fov": np.degrees(2 * np.arctan(times * half))}
    else:
        half, moved = np.asarray(camera.extent, np.float64) / 2, 3
        lens = {"extent": 2 * times * half}
    matrix[:, moved] += half * (sx * matrix[:, 0] + sy * matrix[:, 1])
    return dataclasses.replace(camera, world_from_camera=matrix, **lens, width=width, height=height)


def _shown(camera: Camera, lens: str) -> str:
    matrix = known(camera.world_from_camera)
    if matrix is None or matrix.shape != (4, 4):
        pose = f"world_from_camera={numbers(camera.world_from_camera)}"
    else:
        pose = f"eye={numbers(matrix[:3, 3])}, looking={numbers(matrix[:3, 2])}"
    return f"{type(camera).__name__}({pose}, {lens}, {camera.width} x {camera.height})"


def require_size(owner: str, width: Any, height: Any) -> None:
    """ArgumentError where a picture cannot have this size."""
    require(owner, "width", width, _PIXELS)
    require(owner, "height", height, _PIXELS)
