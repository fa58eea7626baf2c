"""Ctrl-C during long computations: KeyboardInterrupt within a moment, and no harm to what comes after. In processes
of their own, which a computation that cannot be interrupted would keep busy for ever."""

import subprocess
import sys

SETUP = """
import os, signal, sys, threading, time, torch, prdp_torch as prdp
from prdp_torch import _C
from prdp_torch.experiments import _C as experiments_C
from prdp_torch.experiments import scenes
signal.signal(signal.SIGINT, signal.default_int_handler)
torch.manual_seed(0)
torch.set_num_threads(2)
FOREVER = 10**12
names = []
def interrupted(name, computation):
    sent = []
    def press():
        time.sleep(0.3)
        sent.append(time.monotonic())
        os.kill(os.getpid(), signal.SIGINT)
    threading.Thread(target=press, daemon=True).start()
    try:
        computation()
    except KeyboardInterrupt:
        late = time.monotonic() - sent[0]
    else:
        raise AssertionError(f"{name}: ended by itself")
    assert late < 5, (name, late)
    # What was interrupted has left nothing behind, on any thread.
    b = torch.randn(64, 1, 33, 33, dtype=torch.float64)
    heat = prdp.Heat((33, 33), 1e-2, 1.0, prdp.CG(500, rtol=1e-10))
    torch.testing.assert_close(heat.operator().apply(heat(b)), b)
    print(name, flush=True)
"""


def run(script):
    """The lines that the script prints."""
    done = subprocess.run([sys.executable, "-c", SETUP + script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, (done.returncode, done.stdout, done.stderr[-3000:])
    return done.stdout.splitlines()


def test_forward_passes():
    lines = run("""
def heat(shape, solver, batch=8):
    return lambda: prdp.Heat(shape, 1e-3, 1.0, solver)(torch.randn(batch, 1, *shape))
def flow(step, channels, shape, solver):
    return lambda: step(shape, 1e-3, 1.0, solver)(torch.randn(8, channels, *shape))
interrupted("jacobi", heat((30,), prdp.Jacobi(FOREVER, rtol=0)))
interrupted("jacobi on threads", heat((256, 256), prdp.Jacobi(FOREVER, rtol=0)))
interrupted("chebyshev", heat((64, 64), prdp.Chebyshev(10**7, rtol=0)))
interrupted("gmres", flow(prdp.Burgers, 2, (64, 64), prdp.GMRES(FOREVER, rtol=0)))
interrupted("multigrid", flow(prdp.NavierStokes, 3, (32, 32), prdp.GMRES(FOREVER, rtol=0, preconditioner="multigrid")))
matrix = torch.eye(900) + 0.01 * torch.randn(900, 900)
descent = prdp.SteepestDescent(FOREVER, rtol=0)
interrupted("dense", lambda: prdp.linear_solve(matrix, torch.randn(900), descent, on_failure="return"))
step = prdp.Heat((30,), 1e-3, 1.0, prdp.Jacobi(1))
interrupted("rollout", lambda: step.rollout(torch.randn(1, 1, 30), 10**7))
tensors = [torch.tensor(1e-3)]
interrupted("plain tensors", lambda: _C.solve_with_tensors(
    torch.randn(4, 1, 30), tensors, "heat", [30], [1.0], False, "jacobi", FOREVER, 0.0))
""")
    expected = ["jacobi", "jacobi on threads", "chebyshev", "gmres", "multigrid", "dense", "rollout", "plain tensors"]
    assert lines == expected


def test_backward_passes():
    lines = run("""
step = prdp.Burgers((64,), 1e-3, 1.0, prdp.GMRES(1, rtol=0), adjoint_max_iter=FOREVER, on_failure="return")
u = step(torch.randn(40, 1, 64, requires_grad=True))
interrupted("adjoint", lambda: u.sum().backward())
nu = torch.tensor(1e-2, requires_grad=True)
step = prdp.Heat((96, 96), nu, 1.0, prdp.CG(800, rtol=0), "unrolled", checkpoint_every="sqrt")
u = step.rollout(torch.randn(64, 1, 96, 96), 60)
interrupted("unrolled", lambda: u.sum().backward())
""")
    assert lines == ["adjoint", "unrolled"]


def test_the_making_of_data(tmp_path):
    lines = run(f"""
import pathlib
os.environ["PRDP_CACHE"] = "{tmp_path}"
text = scenes.available()["burgers_2d"].read_text().replace("train = 400", "train = 4000")
pathlib.Path("{tmp_path}/big.toml").write_text(text)
scene = scenes.load("{tmp_path}/big.toml")
interrupted("data", lambda: experiments_C.make_dataset(scene))
""")
    assert lines == ["data"] and [path.name for path in tmp_path.iterdir()] == ["big.toml"]


def test_other_threads_and_handlers_run_while_a_solve_does():
    """A handler that returns lets the solve go on; it cannot solve in the middle of it."""
    lines = run("""
counted, seen = 0, []
def count():
    global counted
    while True:
        counted += 1
        time.sleep(0.01)
threading.Thread(target=count, daemon=True).start()
def handler(*_):
    try:
        prdp.Heat((30,), 1e-3, 1.0, prdp.Jacobi(1))(u)
    except RuntimeError as error:
        seen.append(str(error))
signal.signal(signal.SIGALRM, handler)
heat = prdp.Heat((30,), 1e-3, 1.0, prdp.Jacobi(10**8, rtol=0))
u = torch.randn(2, 1, 30)
signal.setitimer(signal.ITIMER_REAL, 0.2)
wanted, during = heat(u), counted
assert seen == ["a signal handler that runs during a solve cannot solve on the same thread"], seen
assert during > 10, during
assert torch.equal(heat(u), wanted)
print("solved")
""")
    assert lines == ["solved"]
