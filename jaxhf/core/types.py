"""Array aliases with named axes, and the one rule for what becomes a leaf of a scene."""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from .errors import ArgumentError, UserError
from .precision import fitted

# What a leaf of a scene may be: float64 NumPy until the scene is rendered, or whatever JAX array or tracer the caller put
# there. A type checker takes it for the latter, which it is wherever rays are traced.
if TYPE_CHECKING:
    AnyArray = jax.Array
else:
    AnyArray = jax.Array | np.ndarray

MOST = 1e30  # of a number in a scene: beyond, products overflow in single precision
MOST_PLACES = 2**31 - 1  # of numbers in an array that several heightfields share: places in it are 32-bit integers

Scalar = Float[jax.Array, ""]
Flag = Bool[jax.Array, ""]
Index = Int[jax.Array, ""]
Vector = Float[jax.Array, "3"]
Point2 = Float[jax.Array, "2"]

ScalarLeaf = Float[AnyArray, ""]
VectorLeaf = Float[AnyArray, "3"]
MatrixLeaf = Float[AnyArray, "4 4"]


def float_leaf(value: Any) -> Any:
    """Keeps a JAX array or tracer of floats as it is; turns anything else into a float64 NumPy array.

    Positions therefore keep double precision until `localise` has moved the origin next to the terrain, even where JAX
    itself runs in single precision. Whole numbers in JAX become floats, as what is computed in their type loses its
    fractions.
    """
    if isinstance(value, jax.Array):
        return value if jnp.issubdtype(value.dtype, jnp.inexact) else value.astype(jnp.result_type(float))
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        shown = repr(value)
        raise UserError(f"{shown if len(shown) <= 60 else type(value).__name__} stands where numbers must") from error


def height_leaf(owner: str, value: Any, dtype: Any = None) -> jax.Array:
    """Heights as an array of JAX, in `dtype` or as they are given, where whole numbers become float32; see `fitted`."""
    if isinstance(value, jax.Array):
        whole = jnp.issubdtype(value.dtype, jnp.integer)
        return value.astype(dtype or (jnp.float32 if whole else value.dtype))
    given = np.asarray(value)
    if given.dtype.kind in "fiu":
        dtype = dtype or (np.float32 if given.dtype.kind in "iu" else jax.dtypes.canonicalize_dtype(given.dtype))
        given = given if given.dtype == dtype else fitted(given, dtype, owner)
    return jnp.asarray(given, dtype)


def rgb_leaf(value: Any) -> Any:
    """A colour: three numbers, or one number that stands for a grey."""
    leaf = float_leaf(value)
    if leaf.shape == ():
        return leaf[None].repeat(3) if isinstance(leaf, jax.Array) else np.repeat(leaf, 3)
    return leaf


def require_number(owner: str, name: str, leaf: Any) -> None:
    """Raises ArgumentError on anything but a single number."""
    if leaf.shape != ():
        raise ArgumentError(owner, name, f"must be one number, its shape is {leaf.shape}")


def require_finite(owner: str, name: str, leaf: Any) -> None:
    """Raises ArgumentError where a value that is known now, not traced, holds a nan, an inf, or more than `MOST`."""
    if not isinstance(leaf, np.ndarray):
        return
    if not np.isfinite(leaf).all():
        raise ArgumentError(owner, name, f"must be finite, it is {np.array2string(leaf, separator=', ')}")
    if not (np.abs(leaf) <= MOST).all():
        raise ArgumentError(
            owner, name, f"must be within -{MOST:g} and {MOST:g}, it is {np.array2string(leaf, separator=', ')}"
        )
