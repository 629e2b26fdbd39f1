"""Progress bars: on a terminal only, and gone when the work is done."""

from typing import Any

from tqdm import tqdm


def bar(**options: Any) -> "tqdm[Any]":
    """A bar on standard error, as `tqdm` with these options; in a pipe it shows nothing."""
    return tqdm(disable=None, leave=False, dynamic_ncols=True, **options)
