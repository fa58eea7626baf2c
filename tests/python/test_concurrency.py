"""Threads that share a stepper, worker processes that solve, and a fork of a process that has threads."""

import copy
import os
import subprocess
import sys
import threading

import pytest
import torch
from torch.utils.data import DataLoader, Dataset

import prdp_torch as prdp

U = torch.randn(6, 1, 30, generator=torch.Generator().manual_seed(0))


def make(k=7):
    return prdp.Heat((30,), nu=1e-3, dt=1.0, solver=prdp.Jacobi(max_iter=k, rtol=0.0))


def at_once(work, count=4):
    found = [None] * count

    def run(i):
        found[i] = work(i)

    threads = [threading.Thread(target=run, args=(i,)) for i in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    return found


def gradients(step, batch):
    u = U[:batch].clone().requires_grad_()
    step(u).square().sum().backward()
    return u.grad


def test_threads_share_a_stepper_but_not_its_info():
    step = make()
    alone = [gradients(make(), batch) for batch in range(1, 5)]

    def work(i):
        return [(gradients(step, i + 1), len(step.info.status)) for _ in range(50)]

    found = at_once(work)
    for i, results in enumerate(found):
        assert all(torch.equal(gradient, alone[i]) for gradient, _ in results)
    # `info` is that of some thread's solve, whole.
    assert {length for results in found for _, length in results} <= {1, 2, 3, 4}
    assert int(step.info.iterations.min()) == 7


def test_threads_with_copies_of_a_stepper_have_their_own_info():
    step = make()

    def work(i):
        own = copy.deepcopy(step)
        own.max_iter = i + 1
        lengths = set()
        for _ in range(50):
            gradients(own, i + 1)
            lengths |= {(len(info.status), int(info.iterations.max())) for info in (own.info, own.adjoint_info)}
        return lengths

    assert at_once(work) == [{(i + 1, i + 1)} for i in range(4)]


class Solved(Dataset):
    """Samples that a worker solves for when they are asked for."""

    def __init__(self):
        self.step = make()

    def __len__(self):
        return len(U)

    def __getitem__(self, i):
        return self.step(U[i : i + 1])[0]


@pytest.mark.parametrize("method", ["fork", "spawn", "forkserver"])
def test_workers_of_a_loader_solve_right(method):
    loader = DataLoader(Solved(), batch_size=3, num_workers=1, multiprocessing_context=method)
    assert torch.equal(torch.cat(list(loader)), make()(U))


def test_a_fork_of_a_process_that_has_threads_solves_on_one():
    """More would wait for ever for the threads of OpenMP, which a fork does not copy; torch's own operations too."""
    script = """
import os, torch, prdp_torch as prdp
torch.set_num_threads(2)
u = torch.randn(64, 1, 2000, generator=torch.Generator().manual_seed(0))
step = prdp.Heat((2000,), nu=1e-3, dt=1e-3, solver=prdp.Jacobi(max_iter=50, rtol=0.0))
whole = step(u)
child = os.fork()
if child == 0:
    torch.set_num_threads(1)
    os._exit(0 if torch.equal(step(u), whole) else 1)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    environment = {**os.environ, "PYTHONWARNINGS": "ignore"}
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=60, env=environment, check=True
    )
    assert done.stdout == "0\n", done.stderr
