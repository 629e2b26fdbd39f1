"""What tells one fit's checkpoint from another's."""

import dataclasses
import hashlib
from typing import Any

import jax
import numpy as np

from .basis import Unknowns
from .options import FitOptions
from .problem import Problem


def fingerprint(problem: Problem, unknowns: Unknowns, options: FitOptions) -> str:
    """A hash of all that decides on the steps: fits of the same fingerprint take the same ones, in whatever process.

    Args:
      problem, unknowns: those at the start; the structure of their pytrees says of what classes and sizes all parts are, and
        how many samples a scene asks for. The mesh does not count: another machine may go on.
      options: for what is not in the problem.
    """
    parts: dict[bool, list[Any]] = {True: [], False: []}
    for field in dataclasses.fields(problem):
        if field.name != "mesh":
            parts[field.metadata.get("static", False)].append(getattr(problem, field.name))
    leaves, structure = jax.tree.flatten((parts[False], unknowns))
    levels = None if options.levels is None else list(options.levels)
    # What is left open is chosen anew on the way, also where it begins with what another fit is given.
    left_open = (options.noise is None, options.settings.edge_samples is None)
    choices = (parts[True], structure, options.solver, levels, options.inner_steps, options.tolerance, left_open)
    digest = hashlib.sha256(repr(choices).encode())
    for leaf in map(np.asarray, leaves):
        digest.update(repr((leaf.shape, leaf.dtype.str)).encode() + leaf.tobytes())
    return digest.hexdigest()
