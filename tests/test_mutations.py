"""Each part of the derivative and of a fit has a test that fails without it.

A copy of the package loses one part, and the named test is run there in a process of its own. It has to be a test of the
default run.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]


class Mutation(NamedTuple):
    """In `module` the text `old`, which is there once, becomes `new`; then `test` must fail."""

    module: str
    old: str
    new: str
    test: str


MUTATIONS = {
    "camera silhouettes": Mutation(
        "boundary/guiding.py",
        "flags = silhouettes(grid, Viewpoint(*camera.viewpoint()))",
        "flags = silhouettes(grid, Viewpoint(*camera.viewpoint())) & False",
        "boundary/test_edges.py::test_crest_alone_moves_with_heights",
    ),
    "terminators": Mutation(
        "boundary/guiding.py",
        "flags = flags | silhouettes(grid, light)",
        "pass",
        "boundary/test_edges.py::test_terminator_moves_with_the_camera",
    ),
    "cast shadows": Mutation(
        "boundary/guiding.py",
        "for light in (None, *casting):",
        "for light in (None,):",
        "boundary/test_edges.py::test_cast_shadow_alone_moves[heights]",
    ),
    "borders": Mutation(
        "boundary/silhouette.py",
        "lambda a, b: a != b",
        "lambda a, b: (a != b) & (a != 0) & (b != 0)",
        "boundary/test_edges.py::test_silhouette_alone_moves_with_heights",
    ),
    "edges under flat shading": Mutation(
        "boundary/guiding.py",
        "return all_edges(grid)",
        "pass",
        "boundary/test_edges.py::test_edges_of_facets_move",
    ),
    "dark side of the shading normal": Mutation(
        "shade/lighting.py",
        "return rounded_clamp(dot(wi, hit.ns) * hit.side.astype(wi.dtype))",
        "return jnp.abs(dot(wi, hit.ns))",
        "shade/test_shade.py::test_coarse_cells_are_dark_beyond_the_terminator[above]",
    ),
    "derivative of the shading normal": Mutation(
        "trace/grid.py",
        "vertex_normals(heights,",
        "vertex_normals(lax.stop_gradient(heights),",
        "rendering/test_gradient.py::test_every_leaf_pixel_by_pixel[parallel]",
    ),
    "derivative of the hit": Mutation(
        "trace/intersect.py",
        "t = plane_distance(plane, ray, found)",
        "t = lax.stop_gradient(plane_distance(plane, ray, found))",
        "rendering/test_gradient.py::test_every_leaf_pixel_by_pixel[parallel]",
    ),
    "which vertices a sample shows": Mutation(
        "fitting/linearise.py",
        "first + jnp.stack(here)",
        "jnp.stack(here)",
        "fitting/test_linearise.py::test_matrix_is_the_derivative_of_render[flat, several objects]",
    ),
    "resampled pixels": Mutation(
        "fitting/linearise.py",
        ".at[edges.resampled].set(finer, unique_indices=True)",
        "",
        "fitting/test_linearise.py::test_matrix_is_the_derivative_of_render[smooth with edges]",
    ),
    "which vertices decide on a point": Mutation(
        "boundary/sample.py",
        "before + jnp.concatenate([ends, triangle])",
        "jnp.concatenate([ends, triangle])",
        "fitting/test_linearise.py::test_a_point_on_an_edge_depends_on_its_deciding_vertices_alone[2-1]",
    ),
    "masks": Mutation(
        "fitting/residuals.py",
        "group.weights * (image - group.targets)",
        "jnp.max(group.weights) * (image - group.targets)",
        "fitting/test_fit.py::test_heights_come_back_from_a_flat_start",
    ),
    "prior": Mutation(
        "fitting/residuals.py",
        "problem.prior.weight * (surface",
        "0 * (surface",
        "fitting/test_fit.py::test_what_is_known_beforehand_counts_in_standard_deviations",
    ),
    "smoothness": Mutation(
        "fitting/residuals.py",
        "problem.smoothness * laplacian(",
        "0 * laplacian(",
        "fitting/test_fit.py::test_what_is_known_beforehand_counts_in_standard_deviations",
    ),
    "smoothness at the border": Mutation(
        "fitting/residuals.py",
        'mode="edge"',
        'mode="constant"',
        "fitting/test_fit.py::test_what_is_known_beforehand_counts_in_standard_deviations",
    ),
    "correlated errors of a prior": Mutation(
        "fitting/residuals.py",
        "stiffness * problem.basis.transform(off)",
        "problem.basis.transform(off)",
        "fitting/test_fit.py::test_errors_of_a_prior_are_correlated_as_whittle_said",
    ),
    "their spread at the border": Mutation(
        "fitting/prior.py",
        "rows.T @ stiffness**-2 @ columns",
        "np.mean(stiffness**-2)",
        "fitting/test_fit.py::test_errors_of_a_prior_are_correlated_as_whittle_said",
    ),
    "their slope at the border": Mutation(
        "fitting/prior.py",
        "math.ceil(length / d)",
        "0 * math.ceil(length / d)",
        "fitting/test_fit.py::test_errors_of_a_prior_are_correlated_as_whittle_said",
    ),
    "robust weight": Mutation(
        "fitting/robust.py",
        '"cauchy" else 1 / (1 + square) ** 2',
        '"cauchy" else 1 / (1 + square)',
        "fitting/test_fit.py::test_softened_residuals_square_to_the_robust_loss[geman]",
    ),
    "exposures": Mutation(
        "fitting/residuals.py",
        "jnp.stack([unknowns.exposures[k] for",
        "jnp.stack([1 + 0 * unknowns.exposures[k] for",
        "fitting/test_fit.py::test_exposures_and_offsets_come_back_apart",
    ),
    "offsets": Mutation(
        "fitting/residuals.py",
        "jnp.stack([unknowns.offsets[k] for",
        "jnp.stack([0 * unknowns.offsets[k] for",
        "fitting/test_fit.py::test_exposures_and_offsets_come_back_apart",
    ),
    "albedo of each texel": Mutation(
        "fitting/residuals.py",
        "jnp.broadcast_to(factor, shape)",
        "jnp.broadcast_to(jnp.mean(factor), shape)",
        "fitting/test_fit.py::test_a_map_of_the_albedo_comes_back",
    ),
    "sign of the damping": Mutation(
        "fitting/solvers.py",
        "high_constant=4.0, low_constant=_REJECTED",
        "high_constant=_REJECTED, low_constant=4.0",
        "fitting/test_fit.py::test_heights_come_back_from_a_flat_start",
    ),
    "mean height at the last level only": Mutation(
        "fitting/basis.py",
        "varied[0, 0] = cutoff >= 1",
        "varied[0, 0] = True",
        "fitting/test_fit.py::test_the_basis_is_the_cosine_transform",
    ),
    "best heights": Mutation(
        "fitting/loop.py",
        "(first or loss <= self.best[0])",
        "True",
        "fitting/test_fit.py::test_a_fit_that_stalls_says_so_and_keeps_the_best",
    ),
    "damping after rejections": Mutation(
        "fitting/loop.py",
        "solver = with_rejections(self.solver, self._rejections())",
        "solver = with_rejections(self.solver, 0)",
        "fitting/test_fit.py::test_rejections_in_a_row_damp_ever_faster_also_after_an_interruption",
    ),
    "stalling": Mutation(
        "fitting/loop.py",
        "if not self.predicted >= self._enough(steps[-1].loss, fine) or",
        "if self.predicted < 0 or",
        "fitting/test_fit.py::test_a_fit_that_stalls_says_so_and_keeps_the_best",
    ),
    "interval of checkpoints": Mutation(
        "fitting/loop.py",
        "len(self.history) % self.options.checkpoint_every == 0",
        "len(self.history) % 1000 == 0",
        "fitting/test_fit_checkpoint.py::test_a_killed_process_loses_at_most_one_interval",
    ),
    "damping of a checkpoint": Mutation(
        "fitting/loop.py",
        "reset_state(self.initial_state, self.unknowns, state)",
        "reset_state(self.initial_state, self.unknowns)",
        "fitting/test_fit_checkpoint.py::test_after_ctrl_c_it_goes_on_to_the_same_bits[4]",
    ),
    "prior in the deviations": Mutation(
        "fitting/uncertainty.py",
        "prior(change), normalised(change)",
        "[0 * part for part in prior(change)], normalised(change)",
        "fitting/test_normal_matrix.py::test_draws_have_its_inverse_as_their_covariance",
    ),
    "pictures in the deviations": Mutation(
        "fitting/uncertainty.py",
        "[root * part for",
        "[0 * root * part for",
        "fitting/test_normal_matrix.py::test_draws_have_its_inverse_as_their_covariance",
    ),
    "draws of their own": Mutation(
        "fitting/normal_matrix.py",
        "np.random.default_rng(seed)",
        "np.random.default_rng(0 * seed)",
        "fitting/test_normal_matrix.py::test_draws_have_its_inverse_as_their_covariance",
    ),
    "boundaries that stand elsewhere": Mutation(
        "fitting/uncertainty.py",
        "[one + tau * other for",
        "[one for",
        "fitting/test_normal_matrix.py::test_boundaries_that_stand_elsewhere_widen_deviations[2.0-0.37]",
    ),
    "priors of draws": Mutation(
        "fitting/normal_matrix.py",
        "right[: moved.size] += moved.ravel()",
        "right[: moved.size] += 0.5 * moved.ravel()",
        "fitting/test_normal_matrix.py::test_draws_have_its_inverse_as_their_covariance",
    ),
    "priors of lights and cameras": Mutation(
        "fitting/normal_matrix.py",
        "weight[None] ** 2, others.view",
        "weight[None], others.view",
        "fitting/test_normal_matrix.py::test_it_is_the_square_of_the_residuals_derivative",
    ),
    "three equal channels": Mutation(
        "fitting/problem.py",
        "target.shape[-1] == 3 and _is_grey",
        "target.shape[-1] == 4 and _is_grey",
        "fitting/test_fit_defaults.py::test_a_grey_picture_with_three_channels_is_one_measurement",
    ),
    "noise that is not given": Mutation(
        "fitting/loop.py",
        "np.maximum(spreads, self.problem.least_noise)",
        "self.noise + 0 * spreads",
        "fitting/test_fit_defaults.py::test_noise_that_is_not_given_is_estimated",
    ),
    "noise that is borne out": Mutation(
        "fitting/uncertainty.py",
        "problem.with_noise(factor * problem.noise)",
        "problem.with_noise(problem.noise)",
        "fitting/test_fit_defaults.py::test_what_is_left_unexplained_counts_as_noise",
    ),
    "shadows to come": Mutation(
        "boundary/guiding.py",
        "jnp.where(folds(",
        "0 * jnp.where(folds(",
        "fitting/test_fit_defaults.py::test_edges_take_part_where_boundaries_are_in_sight",
    ),
    "squares of samples": Mutation(
        "fitting/uncertainty.py",
        "total + draw * draw,",
        "total + draw,",
        "fitting/test_fit_defaults.py::test_samples_can_be_stopped_with_what_is_there",
    ),
    "what is not seen": Mutation(
        "fitting/fit.py",
        "np.asarray(influence) != 0",
        "np.isfinite(np.asarray(influence))",
        "fitting/test_fit.py::test_what_no_picture_shows_is_marked",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MUTATIONS)
def test_a_test_fails_without(name, tmp_path):
    module, old, new, test = MUTATIONS[name]
    for part in ("jaxhf", "tests"):
        shutil.copytree(ROOT / part, tmp_path / part, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    path = tmp_path / "jaxhf" / module
    text = path.read_text()
    assert text.count(old) == 1, f"{module} no longer has this text once: {old}"
    path.write_text(text.replace(old, new))
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"tests/{test}"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}  # before an installed jaxhf
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    # 1: some tests failed; other numbers stand for none found, errors of collection and the like.
    assert done.returncode == 1, done.stdout[-2000:] + done.stderr[-2000:]
    assert "AssertionError" in done.stdout, done.stdout[-2000:]
