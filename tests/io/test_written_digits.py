"""Heights in a text file keep every bit of their type and have no more digits than that takes."""

import numpy as np
import pytest

import jaxhf


@pytest.mark.parametrize(("dtype", "digits"), [(np.float32, 9), (np.float64, 17)])
def test_heights_keep_their_bits_in_text(tmp_path, dtype, digits):
    heights = (1000 * np.random.default_rng(0).uniform(size=(4, 5))).astype(dtype)
    jaxhf.save_heights(tmp_path / "heights.asc", jaxhf.Terrain(heights, 2.0, 2.0))
    words = [line.split() for line in (tmp_path / "heights.asc").read_text().splitlines()[-4:]]
    np.testing.assert_array_equal(np.array(words, float)[::-1].astype(dtype), heights)
    assert max(len(word.replace(".", "")) for row in words for word in row) <= digits
