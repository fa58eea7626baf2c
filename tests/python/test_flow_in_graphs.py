"""What `Flow` says to torch.compile and torch.export, whose graphs cannot hold its steps."""

import subprocess
import sys

import pytest
import torch

import prdp_torch as prdp

NAMES = ["forward", "step_and_pressure", "rollout", "project", "pressure", "divergence"]


def called(name):
    """A function of u that calls a method of a flow, and u."""
    torch.manual_seed(0)
    flow = prdp.Flow((8, 6), 0.1, 0.01)
    more = (2,) if name == "rollout" else ()
    return lambda u: getattr(flow, name)(2 * u, *more), flow.project(torch.randn(2, 2, 8, 6))


def first(found):
    return found[0] if isinstance(found, tuple) else found


@pytest.mark.parametrize("name", NAMES)
def test_a_compiled_function_calls_it_between_graphs(name):
    call, u = called(name)
    graphs = []

    def count(graph, _):
        graphs.append(graph)
        return graph

    assert torch.equal(first(torch.compile(call, backend=count)(u)), first(call(u))) and len(graphs) == 1
    words = f"Flow.{name} of prdp_torch is called between graphs, not traced: compile without fullgraph=True"
    with pytest.raises(torch._dynamo.exc.Unsupported, match=words):
        torch.compile(call, backend="eager", fullgraph=True)(u)


COMPILED_FIRST = """
import torch, prdp_torch as prdp
try:
    torch.compile(prdp.Flow((8, 6), 0.1, 0.01), backend="eager", fullgraph=True)(torch.zeros(2, 2, 8, 6))
except torch._dynamo.exc.Unsupported as error:
    print(error)
"""


def test_a_compiled_flow_says_so_in_a_process_that_called_none_before():
    done = subprocess.run([sys.executable, "-c", COMPILED_FIRST], capture_output=True, text=True, check=True)
    assert "Flow.forward of prdp_torch is called between graphs, not traced" in done.stdout


class Wrapped(torch.nn.Module):
    def __init__(self, call):
        super().__init__()
        self.call = call

    def forward(self, u):
        return self.call(u)


@pytest.mark.parametrize("name", NAMES)
def test_an_export_is_refused_in_words(name):
    call, u = called(name)
    with pytest.raises(NotImplementedError, match=f"Flow.{name}: torch.export cannot hold a step of Flow, which looks"):
        torch.export.export(Wrapped(call), (u,), strict=False)
