"""A fit on several devices, which can be had only before JAX is first used: in a process of its own."""

import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)
import jaxhf
from test_fit_checkpoint import OPTIONS, problem

spent = [0.0]

def add(event, duration_secs, **_):
    if event.startswith("/jax/core/compile/"):
        spent[0] += duration_secs

jax.monitoring.register_event_duration_secs_listener(add)
by_then = []
jaxhf.fit(*problem(), **OPTIONS, progress=lambda step: by_then.append(spent[0]))
print(len(jax.devices()), by_then[0], by_then[-1])
"""


@pytest.mark.slow
def test_steps_are_compiled_once_on_two_devices():
    """Where a step's results lay elsewhere than its arguments, two thirds of the compilation came after the first step."""
    here = Path(__file__).parent
    program = f"import sys; sys.path[:0] = [{str(here.parents[1])!r}, {str(here)!r}]\n{PROGRAM}"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    devices, first, last = map(float, run.stdout.split())
    assert devices == 2
    assert last < 1.2 * first
