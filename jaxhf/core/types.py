"""Array aliases with named axes, what becomes a leaf of a scene, and the rules that numbers keep."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from .errors import ArgumentError, UserError, kind_of
from .precision import numbers, require_fit

# What a leaf of a scene may be: float64 NumPy until the scene is rendered, or whatever JAX array or tracer the caller put
# there. A type checker takes it for the latter, which it is wherever rays are traced.
if TYPE_CHECKING:
    AnyArray = jax.Array
else:
    AnyArray = jax.Array | np.ndarray

MOST = 1e30  # of a number in a scene: beyond, products overflow in single precision
MOST_PLACES = 2**31 - 1  # of numbers in an array that several heightfields share: places in it are 32-bit integers
_ALIGNED = 64  # bytes, of XLA's arrays on CPUs

Scalar = Float[jax.Array, ""]
Flag = Bool[jax.Array, ""]
Index = Int[jax.Array, ""]
Vector = Float[jax.Array, "3"]
Point2 = Float[jax.Array, "2"]

ScalarLeaf = Float[AnyArray, ""]
VectorLeaf = Float[AnyArray, "3"]
MatrixLeaf = Float[AnyArray, "4 4"]


def float_leaf(value: Any) -> Any:
    """Keeps a JAX array or tracer of floats as it is; turns anything else into a float64 NumPy array of its own.

    Positions therefore keep double precision until `localise` has moved the origin next to the terrain, even where JAX
    itself runs in single precision. Whole numbers in JAX become floats, as what is computed in their type loses its
    fractions. What is masked is nan.
    """
    if isinstance(value, jax.Array):
        return value if jnp.issubdtype(value.dtype, jnp.inexact) else value.astype(jnp.result_type(float))
    try:
        return np.array(numbers(value), dtype=np.float64)
    except (TypeError, ValueError) as error:
        shown = repr(value)
        raise UserError(f"{shown if len(shown) <= 60 else type(value).__name__} stands where numbers must") from error


def height_leaf(owner: str, name: str, value: Any, dtype: Any = None) -> jax.Array:
    """Heights as an array of JAX, in `dtype`, or in float32 or float64 as they are given; see `numbers` and `require_fit`.

    Whole numbers become float32. ArgumentError where they are no real numbers.
    """
    try:
        given = value if isinstance(value, jax.Array) else numbers(value)
    except (TypeError, ValueError) as error:  # lists of several lengths
        raise ArgumentError(owner, name, f"must be an array of real numbers, they are {kind_of(value)}") from error
    if not (jnp.issubdtype(given.dtype, jnp.floating) or jnp.issubdtype(given.dtype, jnp.integer)):
        found = given.dtype if isinstance(value, jax.Array | np.ndarray) else kind_of(value)
        hint = ": take its .heightfield()" if hasattr(value, "heightfield") else ""
        raise ArgumentError(owner, name, f"must be an array of real numbers, they are {found}{hint}")
    exact = given.dtype in (jnp.float32, jnp.float64)
    dtype = dtype or (jax.dtypes.canonicalize_dtype(given.dtype) if exact else jnp.dtype(jnp.float32))
    if isinstance(given, jax.Array):
        return given.astype(dtype)
    require_fit(given, dtype, owner)
    return array_leaf(given, dtype)


def array_leaf(value: Any, dtype: Any) -> jax.Array:
    """An array of JAX's, which what is done to NumPy's afterwards does not change. What is masked is nan; TypeError where
    there are no numbers."""
    if isinstance(value, jax.Array):
        return jnp.asarray(value, dtype)
    given, dtype = numbers(value), np.dtype(dtype)
    if given.dtype.kind not in "biuf":
        raise TypeError(f"{given.dtype} stands where numbers must")
    copy = room(given.shape, dtype)  # of which there is no second one on a CPU
    copy[...] = given
    return jnp.asarray(copy, dtype)


def room(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """An array without values, whose memory JAX's CPU devices share, as it begins where XLA's own do."""
    size = math.prod(shape) * dtype.itemsize
    memory = np.empty(size + _ALIGNED, np.uint8)
    begin = -memory.ctypes.data % _ALIGNED
    return memory[begin : begin + size].view(dtype).reshape(shape)


def rgb_leaf(value: Any) -> Any:
    """A colour: three numbers, or one number that stands for a grey."""
    leaf = float_leaf(value)
    return leaf[None].repeat(3) if leaf.shape == () else leaf


class Number(NamedTuple):
    """The rule of a number, or of an array. What is JAX's, and so may be traced, is asked for its shape alone.

    Attributes:
      words: what it must, "be positive and finite".
      holds: whether it does, number by number; none may be beyond `MOST`.
      shape: of the array; None: any.
      shape_words: that shape in words, "hold three numbers".
    """

    words: str = "be finite"
    holds: Callable[[Any], Any] = np.isfinite
    shape: tuple[int, ...] | None = ()
    shape_words: str = "be one number"

    def __call__(self, value: Any) -> str | None:
        if self.shape is not None and np.shape(value) != self.shape:
            return f"must {self.shape_words}, its shape is {np.shape(value)}"
        if isinstance(value, jax.Array):
            return None
        given = np.asarray(value)
        for words, holds in ((self.words, self.holds(given)), (f"be within -{MOST:g} and {MOST:g}", np.abs(given) <= MOST)):
            if not np.all(holds):
                return f"must {words}, it is {given.tolist()}"
        return None


FINITE = Number()
NUMBERS = Number(shape=None)
POSITIVE = Number("be positive and finite", lambda value: 0 < value < np.inf)
ANGLE_OF_VIEW = Number("lie between 0 and 180 degrees", lambda value: 0 < value < 180)
VECTOR = Number(shape=(3,), shape_words="hold three numbers")
COLOUR = Number(shape=(3,), shape_words="be one number or three")  # one is a grey, see `rgb_leaf`
