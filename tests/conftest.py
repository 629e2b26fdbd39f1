"""Tests run as users run jaxhf, in single precision and without flags, but for two things.

Types and ranks do not promote by themselves; and programs are compiled without most optimisations, in half the time. What
needs the bits or the speed of users' programs is marked `optimised`; `--optimised FOLDER` compiles all of a folder so.
"""

import gc
import os
import tempfile
import threading
import time
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jaxlib.version
import jaxtyping
import pytest
from jax._src import compiler  # JAX has no other way to give options to every program

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
# To look for garbage, and to note where each equation came from, is a fifth of the time that tracing takes.
gc.disable()
jax.config.update("jax_traceback_in_locations_limit", 0)

# Without most optimisations XLA is spared more: emitters of loops that go through MLIR, which jaxlib 0.11 has no others than;
# and to deal out kernels of microseconds to threads. One module of LLVM in place of up to 32 would spare as much again, but
# rounds in other places: 20 of 18,970 rays then come in between terrain and walls (tests/trace/test_skirt.py).
SPARED: dict[str, Any] = {"xla_disable_hlo_passes": "cpu-parallel-task-assigner"}
if jaxlib.version.__version_info__ < (0, 11):
    SPARED["xla_cpu_use_fusion_emitters"] = False
_options_of_jax = compiler.get_compile_options


def _compile_options(*args: Any, env_options_overrides: Any = None, **others: Any) -> Any:
    """JAX's, for each program."""
    spared = SPARED if jax.config.read("jax_disable_most_optimizations") else {}
    return _options_of_jax(*args, env_options_overrides={**(env_options_overrides or {}), **spared}, **others)


compiler.get_compile_options = _compile_options

SEEDS = Path(__file__).parents[2] / "shared" / "pbrt"


def pytest_addoption(parser: pytest.Parser) -> None:
    said = "compile programs of all tests in a folder as users do, say --optimised tests/trace; again for another"
    parser.addoption("--optimised", action="append", default=[], metavar="FOLDER", help=said)
    parser.addoption("--no-skips", action="store_true", help="fail where a test was skipped")


def pytest_configure(config: pytest.Config) -> None:
    """Compiled programs are shared by all workers and by the processes that tests start, and by later runs."""
    if not hasattr(config, "workerinput") and "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(_programs(config))  # workers and other processes inherit it
    jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
    for name, value in (("jax_persistent_cache_min_compile_time_secs", 0.1), ("jax_persistent_cache_min_entry_size_bytes", -1)):
        os.environ[name.upper()] = str(value)
        jax.config.update(name, value)


def _programs(config: pytest.Config) -> Path:
    """Pytest's own cache, a folder for each jaxlib; what no run asked for in two weeks is removed. Without it, a run's own."""
    if not hasattr(config, "cache"):  # -p no:cacheprovider
        temporary = tempfile.TemporaryDirectory(prefix="jaxhf-tests-", ignore_cleanup_errors=True)
        config.add_cleanup(temporary.cleanup)
        return Path(temporary.name)
    folder = config.cache.mkdir(f"programs-{version('jaxlib')}")
    for path in folder.iterdir():
        used = path.stat()
        if time.time() - max(used.st_atime, used.st_mtime) > 14 * 86400:
            path.unlink()
    return folder


def pytest_sessionfinish(session: pytest.Session) -> None:
    """`--no-skips`: what was not tried is not proven. Each reason is in pytest's summary."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if session.config.option.no_skips and reporter and reporter.stats.get("skipped") and session.exitstatus == 0:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.hookimpl(tryfirst=True)  # before what fixtures compile
def pytest_runtest_setup(item: pytest.Item) -> None:
    """What `x64`, `optimised` and `slow` ask for; how programs are compiled goes to processes that a test starts, too.

    Most of the time goes into compilation, and most checks hold whatever a compiler does with rounding.
    """
    x64 = item.get_closest_marker("x64")
    jax.config.update("jax_enable_x64", x64 is not None and x64.args != (False,))
    optimised = any(map(item.get_closest_marker, ("optimised", "slow")))
    optimised |= any(item.path.is_relative_to(item.config.rootpath / folder) for folder in item.config.option.optimised)
    if jax.config.read("jax_disable_most_optimizations") == optimised:
        jax.clear_caches()  # which do not know how their programs were compiled
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(not optimised)
    jax.config.update("jax_disable_most_optimizations", not optimised)


@pytest.fixture(autouse=True, scope="module")
def unload_programs() -> Iterator[None]:
    """A compiled program holds some hundred and fifty mappings of memory, and Linux allows a process 65530: it aborts there."""
    yield
    mappings = Path("/proc/self/maps")
    if not mappings.exists() or mappings.read_bytes().count(b"\n") > 15_000:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="session")
def seeds() -> Path:
    """The folder of the seed scenes and of their references by pbrt-v2, which lie beside the project, not in it."""
    if not SEEDS.is_dir():
        pytest.skip("shared/pbrt, the larger seed scenes with pbrt-v2's references, are not beside the project")
    return SEEDS


@pytest.fixture
def as_users_call_it() -> Iterator[None]:
    """Where nobody checks annotations: else jaxtyping refuses much of what a message of ours answers."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


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


@pytest.fixture
def programs(monkeypatch) -> list[tuple[str, bool]]:
    """Of each program that jaxhf has compiled, the function's name, and whether another thread did it."""
    from jaxhf.xla.kept import Program  # not before annotations are checked

    found, stored = [], Program._stored

    def noted(self, *args):
        found.append((self.name.rpartition(".")[2], threading.current_thread() is not threading.main_thread()))
        return stored(self, *args)

    monkeypatch.setattr(Program, "_stored", noted)
    return found


@pytest.fixture
def traced(monkeypatch) -> list[tuple[str, ...]]:
    """What was traced for tiles."""
    from jaxhf.rendering import tiles  # not before annotations are checked

    found, trace_tile = [], tiles._trace_tile

    def noted(aovs, *args):
        found.append(aovs)
        return trace_tile(aovs, *args)

    monkeypatch.setattr(tiles, "_trace_tile", noted)
    return found
