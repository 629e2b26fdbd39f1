"""Where a fit stands: what a checkpoint holds, no more and no less."""

import dataclasses
import hashlib
import itertools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...io.checkpoint import load_arrays, load_facts_of, save_checkpoint
from ..given import Given, Step
from ..model.problem import Problem
from ..model.surface import Unknowns, make_basis
from ..model.terms import OCTAVES


@dataclasses.dataclass(frozen=True)
class State:
    """Immutable; a step makes another one.

    Attributes:
      unknowns: those that were accepted last, about `base`.
      begin: those at which the present stage began, with coefficients 0.
      base: the surface there, shape (my, mx).
      units: of the modes, see `Basis.scale`, shape (my, mx).
      others: the curvature along the other unknowns, see `balanced`.
      noise, loss_scale: see `Problem`.
      widths: how many times wider than their prior heights vary, see `Estimate`; 1 where that is not estimated.
      step_size: 1 / λ of the next step.
      stage: the number of the stage, from 0; -1: none has begun.
      stage_start: steps taken before it.
      edge_samples: points on edges.
      loss: at `unknowns`.
      predicted: by how much the next step is to lower it, see `Outcome`.
      seconds: since the fit began, a resumed one goes on counting.
      history: a `Step` for each step.
    """

    unknowns: Unknowns
    begin: Unknowns
    base: Float[Array, "my mx"]
    units: Float[np.ndarray, "my mx"]
    others: Any
    noise: Float[np.ndarray, " pictures"]
    widths: Float[np.ndarray, " octaves"]
    loss_scale: Float[Array, ""]
    step_size: Float[Array, ""]
    stage: int = -1
    stage_start: int = 0
    edge_samples: int = 0
    loss: float = float("inf")
    predicted: float = 0.0
    seconds: float = 0.0
    history: tuple[Step, ...] = ()

    @property
    def steps(self) -> tuple[Step, ...]:
        """Those of the present stage."""
        return self.history[self.stage_start :]

    @property
    def rejections(self) -> int:
        """How many of them were rejected since the last accepted one."""
        return len(list(itertools.takewhile(lambda step: not step.accepted, reversed(self.steps))))

    def posed(self, problem: Problem, share: float) -> Problem:
        """The problem of this stage, which varies such a share of the modes, but for the noise."""
        basis = make_basis(problem.field, np.asarray(self.base), self.units, share, problem.basis.free)
        problem = dataclasses.replace(problem.widened(self.widths), basis=basis, loss_scale=self.loss_scale)
        return problem.with_edge_samples(self.edge_samples)


_ARRAYS = ("unknowns", "begin", "base", "units", "others", "noise", "widths", "loss_scale", "step_size")


def first_state(problem: Problem, unknowns: Unknowns) -> State:
    """Before the first stage."""
    dtype = problem.field.heights.dtype
    return State(
        unknowns,
        unknowns,
        problem.basis.base,
        np.asarray(problem.basis.scale, np.float64),
        jax.tree.map(np.ones_like, unknowns.without_modes()),
        problem.noise,
        np.ones(OCTAVES),
        problem.loss_scale,
        jnp.ones((), dtype),
        edge_samples=problem.settings.edge_samples or 0,
    )


def save_state(path: Path, state: State, fingerprint: str) -> None:
    facts = {field.name: getattr(state, field.name) for field in dataclasses.fields(state) if field.name not in _ARRAYS}
    arrays = [getattr(state, name) for name in _ARRAYS]
    facts["history"] = [list(step) for step in state.history]
    facts |= {"fingerprint": fingerprint, "shapes": [leaf.shape for leaf in jax.tree.leaves(arrays)]}
    save_checkpoint(path, facts, arrays)


def load_state(path: Path, like: State, fingerprint: str) -> State:
    """The state of a checkpoint; FileError where it is another fit's. `like`: the state before the first stage."""
    facts = load_facts_of(path, fingerprint)
    leaves, structure = jax.tree.flatten([getattr(like, name) for name in _ARRAYS])
    shapes = zip(facts.pop("shapes"), leaves, strict=True)  # those of a finer level may be others
    blank = [(jnp if isinstance(leaf, jax.Array) else np).zeros(shape, leaf.dtype) for shape, leaf in shapes]
    arrays = dict(zip(_ARRAYS, load_arrays(path, jax.tree.unflatten(structure, blank)), strict=True))
    facts["history"] = tuple(Step(*line) for line in facts["history"])
    return State(**arrays, **facts)


def fingerprint(problem: Problem, unknowns: Unknowns, given: Given) -> str:
    """A hash of all that decides on the steps: fits of the same fingerprint take the same ones, in whatever process.

    The structure of the problem and the unknowns at the start says of what classes and sizes all parts are, and how many
    samples a scene asks for. The mesh does not count: another machine may go on.
    """
    parts = {field.name: getattr(problem, field.name) for field in dataclasses.fields(problem) if field.name != "mesh"}
    settings = parts.pop("settings")
    leaves, structure = jax.tree.flatten((parts, unknowns))
    # What is left open is chosen anew on the way, also where it begins with what another fit is given.
    choices = (settings, structure, given.noise is None, given.settings.edge_samples is None)
    return digest(choices, leaves)


def digest(choices: Any, values: Any) -> str:
    """A hash of what `repr` tells of choices, and of the bits of a pytree's leaves."""
    found = hashlib.sha256(repr(choices).encode())
    for leaf in map(np.asarray, jax.tree.leaves(values)):
        found.update(repr((leaf.shape, leaf.dtype.str)).encode() + leaf.tobytes())
    return found.hexdigest()
