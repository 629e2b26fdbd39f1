"""Strictness for every test: double precision is there, types do not promote by themselves, ranks neither."""

import gc
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
# Tracing makes many objects that live on: with fewer collections of them it takes a fifth less time.
gc.freeze()
gc.set_threshold(50_000, 50, 100)

SEEDS = Path(__file__).parents[2] / "shared" / "pbrt"
PEERS = Path(__file__).parents[2] / "shared" / "peers"


def pytest_configure(config: pytest.Config) -> None:
    """Compiled programs are shared by all workers and by the processes that tests start, for the length of this run."""
    if not hasattr(config, "workerinput") and "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = tempfile.TemporaryDirectory(prefix="jaxhf-tests-", ignore_cleanup_errors=True)
        config.add_cleanup(folder.cleanup)
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder.name  # workers and other processes inherit it
    jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
    # What tests compile themselves, gradients above all, is compiled as jaxhf compiles its own programs: in 0.8 of the time.
    if jax.__version_info__ < (0, 11):  # XLA ends a process that is given a flag which is no longer there
        os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_use_fusion_emitters=false"
    for name, value in (("jax_persistent_cache_min_compile_time_secs", 0.1), ("jax_persistent_cache_min_entry_size_bytes", -1)):
        os.environ[name.upper()] = str(value)
        jax.config.update(name, value)


@pytest.hookimpl(tryfirst=True)  # before what fixtures compile
def pytest_runtest_setup(item: pytest.Item) -> None:
    """What `unoptimised` asks for, here and in processes that a test starts; `unoptimised(False)` excepts a test."""
    marker = item.get_closest_marker("unoptimised")
    unoptimised = marker is not None and marker.args != (False,)
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(unoptimised)
    jax.config.update("jax_disable_most_optimizations", unoptimised)


@pytest.fixture(autouse=True, scope="module")
def unload_programs() -> Iterator[None]:
    """A compiled program holds some hundred and fifty mappings of memory, and Linux allows a process 65530: it aborts there."""
    yield
    jax.clear_caches()


@pytest.fixture(scope="session")
def seeds() -> Path:
    """The folder of the seed scenes and of their references by pbrt-v2, which lie beside the project, not in it."""
    if not SEEDS.is_dir():
        pytest.skip("the seed scenes and pbrt-v2's references are not on this machine")
    return SEEDS


@pytest.fixture(scope="session")
def peers() -> Path:
    """The folder of the common work and of what other renderers made of it."""
    if not PEERS.is_dir():
        pytest.skip("the peers' measurements are not on this machine")
    return PEERS


@pytest.fixture
def compilations() -> Iterator[list[str]]:
    """JAX's events of compilation, since the test began: `clear` it before what must not compile."""
    events = []

    def listen(event, duration_secs, **_):
        if event.startswith("/jax/core/compile/"):
            events.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield events
    jax.monitoring.unregister_event_duration_listener(listen)
