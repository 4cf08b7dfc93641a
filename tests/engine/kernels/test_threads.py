"""How many threads work changes nothing: each part of the work writes what is its own.

In a process of its own, since `make test` gives the processes of the tests one thread each.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
SCRIPT = """
import sys, numba, numpy as np, torch
from fusedrf_cli.engine import kernels
from fusedrf_cli.engine.fields.computed import Batch
from fusedrf_cli.engine.rendering.volume import reach_of
from tests.engine.conftest import points_in, rays_at, unit
from tests.engine.kinds.cases import KINDS
field, rng = KINDS[sys.argv[1]](), np.random.default_rng(1)
points, dirs = points_in(field.aabb, 20_000), unit(rng.normal(size=(20_000, 3)))
points, dirs = torch.from_numpy(points), torch.from_numpy(dirs)
d_sigma, d_rgb = torch.from_numpy(rng.random(20_000)), torch.from_numpy(rng.random((20_000, 3)))
rays, count = rays_at(field.aabb, 2000), 2000
batch = Batch(*rays, rng.random(count), rng.random((count, 4)), rng.random((count, 3)), 0.3, 0.0, 0.1, 1e-3)
for threads in (1, 2, 4):
    kernels.set_threads(threads)
    out, grads, loss = np.zeros((count, 5)), np.zeros((4, field.params.numel())), np.zeros((4, 3))
    found = [x.numpy() for x in field.query(points, dirs)]
    field.render_rays(*rays, reach_of(len(out), 0.0, np.inf), 0.1, 1e-3, out)
    field.train_rays(batch, grads, loss)
    field.query_backward(points, dirs, d_sigma, d_rgb, grads)
    found += [out, grads, loss]
    wanted = found if threads == 1 else wanted
    same = [a.tobytes() == b.tobytes() for a, b in zip(found, wanted)]
    print(numba.get_num_threads(), all(same), all(x.any() for x in found))
"""


@pytest.mark.parametrize("kind", ["dense", pytest.param("vm", marks=pytest.mark.slow)])
def test_any_number_of_threads_gives_the_same_bytes(kind):
    """The loops over items are those of every kind; those of a grid are compiled soonest."""
    environment = os.environ | {"NUMBA_NUM_THREADS": "4"}
    command = [sys.executable, "-c", SCRIPT, kind]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n")[:-1] == ["1 True True", "2 True True", "4 True True"]
