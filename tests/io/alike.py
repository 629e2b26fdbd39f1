"""What was read beside what is built in Python."""

import jax
import numpy as np


def assert_same(found, expected, rtol=0.0, atol=0.0):
    """Asserts that two values of jaxhf's have the same classes, sizes and numbers; shapes and dtypes count."""
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for (where, leaf), other in zip(jax.tree_util.tree_leaves_with_path(found), jax.tree.leaves(expected), strict=True):
        said = jax.tree_util.keystr(where)
        assert leaf.dtype == other.dtype, said
        np.testing.assert_allclose(leaf, other, err_msg=said, strict=True, rtol=rtol, atol=atol)


def placed(terrain):
    return terrain.dx, terrain.dy, terrain.x0, terrain.y0
