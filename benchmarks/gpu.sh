#!/usr/bin/env bash
# On a machine with a GPU that JAX finds: the fast tests on it, then frames, gradients and fits, each on the CPU and on the GPU,
# and frames by how many rays are traced at once. From a checkout with the test extras and JAX for the GPU:
#   pip install -e '.[test]' 'jax[cuda12]'; benchmarks/gpu.sh [FOLDER, by default gpu-results]
# PLATFORM=rocm or tpu for others; PEERS is the folder of common_work.py for gradients and fits, else they are left out. It ends
# with 1 where a part failed. Nobody has run it on a GPU yet.
set -uo pipefail
cd "$(dirname "$0")/.."
platform=${PLATFORM:-cuda} out=${1:-gpu-results} failed=0
python=$([ -x .venv/bin/python ] && echo .venv/bin/python || echo python)
mkdir -p "$out"
export JAXHF_CACHE=0
JAX_PLATFORMS=$platform,cpu "$python" -c "import jax; print(jax.__version__, jax.devices())" | tee "$out/device.txt" || exit 2

JAX_PLATFORMS=$platform,cpu "$python" -m pytest -q 2>&1 | tee "$out/tests.txt" | tail -15 || failed=1
for on in cpu "$platform,cpu"; do
  name=${on%%,*}
  JAX_PLATFORMS=$on "$python" benchmarks/forward.py --devices 1 --csv "$out/forward-$name.csv" || failed=1
  if [ -n "${PEERS:-}" ]; then
    JAX_PLATFORMS=$on "$python" benchmarks/gradient.py --peers "$PEERS" --devices 1 --csv "$out/gradient-$name.csv" || failed=1
    JAX_PLATFORMS=$on "$python" benchmarks/recover.py scale --peers "$PEERS" --sizes 64 128 256 --devices 1 \
      --csv "$out/recover-$name.csv" || failed=1
  fi
  JAX_PLATFORMS=$on "$python" - <<'PROGRAM' | tee "$out/chunks-$name.txt" || failed=1
import time
import jax, numpy as np
import jaxhf
from jaxhf.scene.procedural import fractal

field = jaxhf.Heightfield(fractal([1024, 1024], seed=3, exponent=2.4, range=(0.0, 150.0)).astype(np.float32), dx=1.0)
camera = jaxhf.Perspective.framing(field, width=1024, height=1024)
scene = jaxhf.Scene([jaxhf.Object(field)], camera, [jaxhf.Directional.from_angles(315, 45)])
for chunk in [2**k for k in range(8, 21, 2)]:
    ready = jaxhf.prepare(scene, jaxhf.Settings(chunk=chunk))
    jaxhf.render(ready).block_until_ready()
    times = []
    for _ in range(7):
        begin = time.perf_counter()
        jaxhf.render(ready).block_until_ready()
        times.append(time.perf_counter() - begin)
    print(f"1024² heights, 1024² pixels, prepared, chunk {chunk}: {1e3 * np.median(times):.2f} ms", flush=True)
PROGRAM
done
echo "in $out: device.txt, tests.txt, and forward, gradient, recover and chunks for cpu and $platform"
exit "$failed"
