"""torch.compile of the plain loops: one graph for one K."""

import torch

from benchmarks import ours
from benchmarks.peers import stencils, torch_eager


def entries(problem):
    if not problem.name.startswith("heat"):
        return  # the cycles of GMRES unroll into a graph that takes minutes to compile
    stencil = stencils.make(problem, torch_eager.Backend, torch.from_numpy)

    def prepare(k):
        torch._dynamo.reset()  # eight graphs of one function, and it would give up compiling
        solve = torch.compile(lambda b: torch_eager.jacobi(stencil, False, b, k), dynamic=False)
        return torch_eager.calls(problem, lambda b, transposed: solve(b.detach()))

    yield ours.Entry("torch.compile, Jacobi", "implicit", [problem.k], prepare, same_as="Jacobi")
