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
        "_lottery.py",
        "flags = silhouettes(grid, Viewpoint(*camera.viewpoint()))",
        "flags = silhouettes(grid, Viewpoint(*camera.viewpoint())) & False",
        "test_edges.py::test_crest_alone_moves_with_heights",
    ),
    "terminators": Mutation(
        "_lottery.py",
        "flags = flags | silhouettes(grid, light)",
        "pass",
        "test_edges.py::test_terminator_moves_with_the_camera",
    ),
    "cast shadows": Mutation(
        "_lottery.py",
        "for light in (None, *casting):",
        "for light in (None,):",
        "test_edges.py::test_cast_shadow_alone_moves[heights]",
    ),
    "borders": Mutation(
        "_silhouette.py",
        "lambda a, b: a != b",
        "lambda a, b: (a != b) & (a != 0) & (b != 0)",
        "test_edges.py::test_silhouette_alone_moves_with_heights",
    ),
    "edges under flat shading": Mutation(
        "_lottery.py",
        "return all_edges(grid)",
        "pass",
        "test_edges.py::test_edges_of_facets_move",
    ),
    "silhouette correction of the shading normal": Mutation(
        "_shade.py",
        "cosine = rounded_abs(dot(wi, hit.ns))",
        "cosine = jnp.maximum(dot(wi, hit.ns), 0)",
        "test_shade.py::test_no_black_holes",
    ),
    "derivative of the shading normal": Mutation(
        "_grid.py",
        "vertex_normals(heights,",
        "vertex_normals(lax.stop_gradient(heights),",
        "test_gradient.py::test_every_leaf_pixel_by_pixel[parallel]",
    ),
    "derivative of the hit": Mutation(
        "_hit.py",
        "t = distance(plane, ray, found)",
        "t = lax.stop_gradient(distance(plane, ray, found))",
        "test_gradient.py::test_every_leaf_pixel_by_pixel[parallel]",
    ),
    "which vertices a sample shows": Mutation(
        "_jacobian.py",
        "before + jnp.stack(here)",
        "jnp.stack(here)",
        "test_jacobian.py::test_matrix_is_the_derivative_of_render[flat, several objects]",
    ),
    "pixels looked at again": Mutation(
        "_jacobian.py",
        ".at[edges.pixels].set(finer, unique_indices=True)",
        "",
        "test_jacobian.py::test_matrix_is_the_derivative_of_render[smooth with edges]",
    ),
    "which vertices decide on a point": Mutation(
        "_edges.py",
        "before + jnp.concatenate([ends, triangle])",
        "jnp.concatenate([ends, triangle])",
        "test_jacobian.py::test_a_point_on_an_edge_depends_on_its_deciding_vertices_alone[2-1]",
    ),
    "masks": Mutation(
        "_residuals.py",
        "group.weights * (image - group.targets)",
        "jnp.max(group.weights) * (image - group.targets)",
        "test_fit.py::test_heights_come_back_from_a_flat_start",
    ),
    "prior": Mutation(
        "_residuals.py",
        "problem.prior.weight * (surface",
        "0 * (surface",
        "test_fit.py::test_what_is_known_beforehand_counts_in_standard_deviations",
    ),
    "smoothness": Mutation(
        "_residuals.py",
        "problem.smoothness * laplacian(",
        "0 * laplacian(",
        "test_fit.py::test_what_is_known_beforehand_counts_in_standard_deviations",
    ),
    "smoothness at the border": Mutation(
        "_residuals.py",
        'mode="edge"',
        'mode="constant"',
        "test_fit.py::test_what_is_known_beforehand_counts_in_standard_deviations",
    ),
    "errors of a prior that hang together": Mutation(
        "_residuals.py",
        "stiffness * problem.basis.amplitudes(off)",
        "problem.basis.amplitudes(off)",
        "test_fit.py::test_errors_of_a_prior_hang_together_as_whittle_said",
    ),
    "their spread at the border": Mutation(
        "_problem.py",
        "rows.T @ stiffness**-2 @ columns",
        "np.mean(stiffness**-2)",
        "test_fit.py::test_errors_of_a_prior_hang_together_as_whittle_said",
    ),
    "their slope at the border": Mutation(
        "_problem.py",
        "math.ceil(length / d)",
        "0 * math.ceil(length / d)",
        "test_fit.py::test_errors_of_a_prior_hang_together_as_whittle_said",
    ),
    "robust weight": Mutation(
        "_residuals.py",
        "1 / (1 + square) ** 2",
        "1 / (1 + square)",
        "test_fit.py::test_softened_residuals_square_to_the_robust_loss[geman]",
    ),
    "exposures": Mutation(
        "_residuals.py",
        "jnp.stack([unknowns.exposures[k] for",
        "jnp.stack([1 + 0 * unknowns.exposures[k] for",
        "test_fit.py::test_exposures_and_offsets_come_back_apart",
    ),
    "offsets": Mutation(
        "_residuals.py",
        "jnp.stack([unknowns.offsets[k] for",
        "jnp.stack([0 * unknowns.offsets[k] for",
        "test_fit.py::test_exposures_and_offsets_come_back_apart",
    ),
    "albedo of each texel": Mutation(
        "_residuals.py",
        "jnp.broadcast_to(factor, shape)",
        "jnp.broadcast_to(jnp.mean(factor), shape)",
        "test_fit.py::test_a_map_of_the_albedo_comes_back",
    ),
    "sign of the damping": Mutation(
        "_solvers.py",
        "high_constant=4.0, low_constant=_SHORTER",
        "high_constant=_SHORTER, low_constant=4.0",
        "test_fit.py::test_heights_come_back_from_a_flat_start",
    ),
    "constant wave at the last level only": Mutation(
        "_unknowns.py",
        "kept[0, 0] = cut >= 1",
        "kept[0, 0] = True",
        "test_fit.py::test_the_basis_is_the_cosine_transform",
    ),
    "best heights": Mutation(
        "_descent.py",
        "and loss <= self.best[0]",
        "and loss <= math.inf",
        "test_fit.py::test_a_fit_that_stalls_says_so_and_keeps_the_best",
    ),
    "impatience": Mutation(
        "_descent.py",
        "solver = impatient(self.solver, self._rejected())",
        "solver = impatient(self.solver, 0)",
        "test_fit.py::test_rejections_in_a_row_damp_ever_faster_also_after_an_interruption",
    ),
    "stalling": Mutation(
        "_descent.py",
        "_REJECTIONS = 5",
        "_REJECTIONS = 200",
        "test_fit.py::test_a_fit_that_stalls_says_so_and_keeps_the_best",
    ),
    "interval of checkpoints": Mutation(
        "_descent.py",
        "len(self.history) % self.every == 0",
        "len(self.history) % 1000 == 0",
        "test_fit_checkpoint.py::test_a_killed_process_loses_at_most_one_interval",
    ),
    "damping of a checkpoint": Mutation(
        "_descent.py",
        "restarted(self.fresh, self.unknowns, state)",
        "restarted(self.fresh, self.unknowns)",
        "test_fit_checkpoint.py::test_after_ctrl_c_it_goes_on_to_the_same_bits[4]",
    ),
    "prior in the deviations": Mutation(
        "_uncertainty.py",
        "known(change), rest(change)",
        "[0 * part for part in known(change)], rest(change)",
        "test_fit.py::test_as_many_heights_lie_within_their_deviations_as_should",
    ),
    "pictures in the deviations": Mutation(
        "_uncertainty.py",
        "[root * part for",
        "[0 * root * part for",
        "test_fit.py::test_as_many_heights_lie_within_their_deviations_as_should",
    ),
    "draws of their own": Mutation(
        "_uncertainty.py",
        "jax.random.key(k)",
        "jax.random.key(0 * k)",
        "test_fit.py::test_sampled_deviations_are_the_exact_ones",
    ),
    "what is not seen": Mutation(
        "_fit.py",
        "np.asarray(influence) != 0",
        "np.isfinite(np.asarray(influence))",
        "test_fit.py::test_what_no_picture_shows_is_marked",
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
