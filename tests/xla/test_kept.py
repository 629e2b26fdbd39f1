"""Programs in a folder: found by all that tracing depends on, and replaced where they are damaged."""

import time
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxhf.xla.compilation import compiled
from jaxhf.xla.kept import LOADED, Program

traced = []


class Pair(eqx.Module):
    a: jax.Array
    b: jax.Array
    name: str = eqx.field(static=True, default="pair")


def scaled(pair, factor, *, power):
    traced.append(power)
    return Pair(factor * pair.a**power, factor * pair.b**power), {"sum": jnp.sum(pair.a)}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxhf.xla.folder._chosen", [tmp_path])
    monkeypatch.setattr("jaxhf.xla.identity._is_code_of_ours", lambda module: True)
    traced.clear()
    return tmp_path


def call(a, factor=2.0, power=2):
    """As a new process does, which knows of the folder alone."""
    pair, more = compiled(scaled, static_argnames=("power",))(Pair(a, jnp.ones(3)), factor, power=power)
    np.testing.assert_array_equal(pair.a, factor * np.asarray(a) ** power)
    np.testing.assert_array_equal(pair.b, np.full(3, factor))
    assert pair.name == "pair"
    assert more["sum"] == a.sum()


def test_a_kept_program_is_not_traced_again(folder):
    loaded = []
    jax.monitoring.register_event_duration_secs_listener(lambda event, *_, **__: loaded.append(event))
    call(np.arange(3.0))
    call(np.arange(3.0) + 1, factor=5.0)
    assert traced == [2]
    assert len(list(folder.iterdir())) == 1
    assert LOADED in loaded
    call(np.arange(3.0), power=3)
    call(np.arange(3, dtype=np.float16))
    call(np.arange(4.0))
    call(jax.device_put(jnp.arange(4.0), jax.devices()[0]))  # kept apart from NumPy's, as its place counts
    assert traced == [2, 3, 2, 2, 2]


def call_both():
    """What follows is begun by the forms of what it will take."""
    first, second, told = compiled(scaled, static_argnames=("power",)), compiled(of_pair), []

    def begin(forms):
        told.append(forms)
        pair, _ = second.compile_ahead(forms[0], np.float32(3))
        assert (pair.a.shape, pair.b.dtype, pair.name) == ((3,), np.float32, "returned")

    pair, _ = first.meanwhile(begin, Pair(jnp.arange(3.0), jnp.ones(2)), np.float32(2), power=2)
    found, _ = second(pair, np.float32(3))
    np.testing.assert_allclose(found.a, 3 * np.sin(2 * np.arange(3.0) ** 2), rtol=1e-5)
    return told


def test_what_follows_is_compiled_meanwhile(folder, programs):
    """And once; where the first is found in the folder, nothing is begun."""
    ((pair, more),) = call_both()
    assert (type(pair.a), pair.a.shape, more["sum"].shape) == (jax.ShapeDtypeStruct, (3,), ())
    assert (sorted(programs), traced) == ([("of_pair", True), ("scaled", True)], [2, "pair"])
    assert len(list(folder.iterdir())) == 2
    assert jax.config.values["jax_enable_compilation_cache"]  # which is off while programs are compiled to be kept
    assert (call_both(), traced) == ([], [2, "pair"])


def test_what_other_threads_would_compile_otherwise_is_not_begun(folder, programs):
    with jax.default_matmul_precision("float32"):
        assert call_both() == []
    assert [other for _, other in programs] == [False, False]


def test_what_goes_wrong_elsewhere_is_raised_where_it_is_called(folder, monkeypatch):
    """And tried once more when that is called again."""
    stored, fails, keeps, pair = Program._stored, [True], compiled(of_pair), Pair(jnp.ones(3), jnp.ones(2))

    def unless_it_fails(self, *args):
        if fails and fails.pop():
            raise RuntimeError("no memory")
        return stored(self, *args)

    monkeypatch.setattr(Program, "_stored", unless_it_fails)
    assert keeps.compile_ahead(pair, np.float32(3)) is not None
    with pytest.raises(RuntimeError, match="no memory"):
        keeps(pair, np.float32(3))
    np.testing.assert_allclose(keeps(pair, np.float32(3))[0].a, 3 * np.sin(np.ones(3)), rtol=1e-5)


def test_another_thread_waits_for_what_is_compiled_ahead(folder, monkeypatch, programs):
    """Also where it came while that was traced."""
    traced_as_it_is, keeps, pair, other = Program._traced, compiled(of_pair), Pair(jnp.ones(3), jnp.ones(2)), []
    thread = ThreadPoolExecutor(1)

    def traced_slowly(self, leaves):
        other.append(thread.submit(keeps, pair, np.float32(3)))
        time.sleep(0.3)
        return traced_as_it_is(self, leaves)

    monkeypatch.setattr(Program, "_traced", traced_slowly)
    keeps.compile_ahead(pair, np.float32(3))
    for found in (other[0].result(), keeps(pair, np.float32(3))):
        np.testing.assert_allclose(found[0].a, 3 * np.sin(np.ones(3)), rtol=1e-5)
    thread.shutdown()
    assert programs == [("of_pair", True)]


def test_errors_of_what_follows_are_those_of_its_own_call(folder):
    def fails(_):
        raise ValueError("not yet")

    pair, _ = compiled(scaled, static_argnames=("power",)).meanwhile(
        fails, Pair(jnp.ones(3), jnp.ones(2)), np.float32(2), power=2
    )
    np.testing.assert_array_equal(pair.a, 2)


def looped(x):
    return jax.lax.while_loop(lambda x: x < 4, lambda x: 2 * x, x)


def test_a_loop_without_reverse_mode_has_forward_mode(folder):
    keeps = compiled(looped)
    value, push = jax.linearize(keeps, jnp.float32(1))
    assert (value, push(jnp.float32(1)), jax.jacfwd(keeps)(jnp.float32(1))) == (4, 4, 4)
    with pytest.raises(ValueError, match="Reverse-mode differentiation does not work"):
        jax.grad(keeps)(jnp.float32(1))


def test_another_source_or_configuration_is_traced_again(folder, monkeypatch):
    call(np.arange(3.0))
    with jax.default_matmul_precision("float32"):
        call(np.arange(3.0))
    monkeypatch.setattr("jaxhf.xla.identity.source", lambda: b"another")
    call(np.arange(3.0))
    assert traced == [2, 2, 2]


def test_cleared_caches_hold_no_program(folder):
    """As they do not know how their programs were compiled."""
    keeps = compiled(scaled, static_argnames=("power",))

    def call_again():
        keeps(Pair(jnp.ones(2), jnp.ones(2)), 2.0, power=2)

    call_again()
    next(folder.iterdir()).unlink()
    call_again()
    assert traced == [2]
    jax.clear_caches()
    call_again()
    assert traced == [2, 2]


def test_what_jax_has_kept_is_not_kept_again(folder, monkeypatch):
    """XLA stores a loaded program without its kernels: it loads, and fails where it runs."""
    before = jax.config.values["jax_persistent_cache_min_compile_time_secs"]
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    try:
        for source in (b"old", b"new", b"new"):
            monkeypatch.setattr("jaxhf.xla.identity.source", lambda source=source: source)
            call(np.arange(5.0))
    finally:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", before)
    assert traced == [2, 2]


def flipped(stored):
    return bytes([*stored[:900], stored[900] ^ 1, *stored[901:]])


@pytest.mark.parametrize("damaged", [lambda stored: stored[:500], lambda _: b"", flipped])
def test_a_damaged_program_is_replaced(folder, damaged):
    call(np.arange(3.0))
    (path,) = folder.iterdir()
    path.write_bytes(damaged(path.read_bytes()))
    with pytest.warns(UserWarning, match="Error reading persistent compilation cache entry for 'scaled'") as said:
        call(np.arange(3.0))
    assert len(said) == 1
    call(np.arange(3.0))
    assert traced == [2, 2]


def test_a_folder_that_is_gone_gets_one_warning(folder):
    folder.rmdir()
    with pytest.warns(UserWarning, match="Error writing persistent compilation cache entry for 'scaled'") as said:
        call(np.arange(3.0))
    assert len(said) == 1
    folder.mkdir()


def test_a_function_within_another_is_not_kept(folder):
    """It may hold values of it."""
    inner = compiled(lambda x: scaled(Pair(x, x), 1.0, power=2)[0].a)
    assert inner(jnp.ones(2)).sum() == 2
    assert not list(folder.iterdir())


class Foreign(eqx.Module):
    a: jax.Array


def twice(foreign):
    traced.append("twice")
    return 2 * foreign.a


def test_what_holds_others_code_is_not_kept(folder, monkeypatch):
    """A user's class may compute otherwise tomorrow, and has the same name. Elsewhere here all code passes for ours."""
    monkeypatch.undo()
    monkeypatch.setattr("jaxhf.xla.folder._chosen", [folder])
    keeps = compiled(twice)
    assert keeps(Foreign(jnp.ones(2))).sum() == 4
    assert keeps(Foreign(jnp.ones(2))).sum() == 4
    assert (traced, list(folder.iterdir())) == (["twice"], [])


def of_pair(pair, factor):
    traced.append("pair")
    return Pair(factor * jnp.sin(pair.a), pair.b, name="returned"), jnp.arange(3)


def test_a_file_of_another_program_is_replaced(folder):
    """As where somebody has renamed it: it is whole, and would compute something else."""

    def both():
        call(np.arange(3.0))
        call(np.arange(3.0), power=3)

    both()
    one, other = folder.iterdir()
    one.write_bytes(other.read_bytes())
    with pytest.warns(UserWarning, match="another program"):
        both()


def derivatives(a):
    """In a process that knows of the folder alone: by reverse and by forward mode, of first and of second order."""
    keeps = compiled(of_pair)

    def loss(a):
        pair, _ = keeps(Pair(a, jnp.ones(2)), np.float32(3))
        assert pair.name == "returned"
        return jnp.sum(pair.a**2) + jnp.sum(pair.b)

    direction = jnp.arange(3.0)
    slope = jax.grad(loss)
    return (
        slope(a),
        jax.jvp(loss, (a,), (direction,))[1],
        jax.linearize(loss, a)[1](direction),
        jax.jvp(slope, (a,), (direction,))[1],
        jax.grad(lambda a: jnp.vdot(slope(a), direction))(a),
        jax.vmap(slope)(jnp.stack([a, a]))[1],
        jax.jit(jax.linearize(loss, a)[1])(direction),
    )


def test_reverse_mode_is_compiled_beside_what_it_needs(folder, programs):
    """Each program once. Forward mode needs one."""
    keeps, a = compiled(of_pair), jnp.arange(3.0)

    def loss(a):
        return jnp.sum(keeps(Pair(a, jnp.ones(2)), np.float32(3))[0].a)

    np.testing.assert_allclose(jax.grad(loss)(a), 3 * np.cos(np.arange(3)), rtol=1e-5)
    assert programs == [("of_pair", True), ("of_pair", True)]
    np.testing.assert_allclose(jax.jvp(loss, (a,), (jnp.ones(3),))[1], 3 * np.cos(np.arange(3)).sum(), rtol=1e-5)
    assert programs[2:] == [("of_pair", False)]


def test_a_batch_compiles_once():
    keeps, a = compiled(of_pair), jnp.ones((4, 3))

    def batched():
        jax.vmap(lambda a: keeps(Pair(a, jnp.ones(2)), np.float32(3))[0].a)(a).block_until_ready()

    batched()
    before = len(traced)
    batched()
    assert len(traced) == before


def test_a_tangent_may_be_a_number():
    """Which is known where the linear function is transposed."""
    keeps = compiled(of_pair)

    def loss(a, factor):
        return jnp.sum(keeps(Pair(a, jnp.ones(2)), factor)[0].a)

    def pushed(direction):
        return jax.jvp(loss, (jnp.ones(3), jnp.float32(2)), (direction, jnp.float32(0.5)))[1] - 1.5 * np.sin(1)

    def of_direction(direction):
        return jax.linearize(loss, jnp.ones(3), jnp.float32(2))[1](direction, jnp.float32(0))

    (transposed,) = jax.linear_transpose(of_direction, jnp.ones(3))(jnp.float32(1))
    np.testing.assert_allclose(transposed, 2 * np.cos(1) * np.ones(3), rtol=1e-6)
    np.testing.assert_allclose(pushed(jnp.zeros(3)), 0, atol=1e-6)


def test_derivatives_are_kept(folder):
    a = jnp.array([0.1, 0.5, 2.0])
    found = derivatives(a)
    before = len(traced)
    again = derivatives(a)
    assert before > 4
    assert traced[before:] == ["pair"]  # by vmap; the linear function is there then for a jit
    slope, curvature, direction = 9 * np.sin(2 * a), 18 * np.cos(2 * a), np.arange(3)
    expected = (
        slope,
        slope @ direction,
        slope @ direction,
        curvature * direction,
        curvature * direction,
        slope,
        slope @ direction,
    )
    for values in (found, again):
        for value, other in zip(values, expected, strict=True):
            np.testing.assert_allclose(value, other, rtol=2e-6)
