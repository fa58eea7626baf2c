"""torch.compile of the plain loops: one graph for one K."""

from functools import partial

import torch

from benchmarks.entries import Entry
from benchmarks.peers import stencils, torch_eager


def entries(problem):
    if problem.kappa is not None and problem.k < 100:  # more iterations would compile for minutes
        yield Entry("torch.compile, CG", "implicit", [problem.k], partial(compiled_cg, problem), same_as="CG")
    if not problem.name.startswith("heat"):
        return  # the cycles of GMRES unroll into a graph that takes minutes to compile
    stencil = stencils.make(problem, stencils.TorchBackend, torch.from_numpy)

    def prepare(k):
        torch._dynamo.reset()  # eight graphs of one function, and it would give up compiling
        solve = torch.compile(lambda b: torch_eager.jacobi(stencil, False, b, k), dynamic=False)
        return torch_eager.calls(problem, lambda b, transposed: solve(b.detach()))

    yield Entry("torch.compile, Jacobi", "implicit", [problem.k], prepare, same_as="Jacobi")


def compiled_cg(problem, k):
    torch._dynamo.reset()

    @partial(torch.compile, dynamic=False)
    def solve(diagonal, lower, upper, b):
        stencil = stencils.Upwind(diagonal, lower, upper, stencils.TorchBackend)
        return torch_eager.cg(stencil, False, b, k)

    def of(stencil, b):
        return solve(stencil.diagonal.detach(), stencil.lower, stencil.upper, b.detach())

    make = lambda kappa: stencils.diffusion(kappa.detach(), problem.dt, stencils.TorchBackend)  # noqa: E731
    return torch_eager.diffusion_calls(problem, make, of)
