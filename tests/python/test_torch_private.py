"""What `prdp_torch/torch_private.py` takes from torch beside its public interface, each by its name."""

import ast
import functools
import re
from pathlib import Path

import pytest
import torch
import torch._dynamo.testing

from prdp_torch import torch_private

PACKAGE = Path(torch_private.__file__).parent
NAMES = [
    "torch._C._DisableFuncTorch",
    "torch._C._are_functorch_transforms_active",
    "torch._C._functorch.get_unwrapped",
    "torch._C._len_torch_dispatch_stack",
    "torch._dynamo.graph_break",
    "torch._C._functorch.is_functorch_wrapped_tensor",
    "torch._C._functorch.maybe_get_bdim",
    "torch.nn.Module._apply",
    "torch.nn.modules.module._global_backward_hooks",
    "torch.nn.modules.module._global_backward_pre_hooks",
    "torch.nn.modules.module._global_forward_hooks",
    "torch.nn.modules.module._global_forward_pre_hooks",
    "torch.utils.checkpoint._StopRecomputationError",
]


def dotted(node):
    """The name of an attribute such as torch._C._functorch, or None."""
    if isinstance(node, ast.Name):
        return node.id
    base = dotted(node.value) if isinstance(node, ast.Attribute) else None
    return base and f"{base}.{node.attr}"


def private_names(path):
    """The names with an underscore that a file takes from torch."""
    tree = ast.parse(path.read_text())
    found = {dotted(node) for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {f"{node.module}.{name.name}" for name in node.names}
        elif isinstance(node, ast.FunctionDef) and node.name in dir(torch.nn.Module):
            found.add(f"torch.nn.Module.{node.name}")
    found = {name for name in found if name and re.match(r"torch\..*\b_(?!_)", name)}
    return {name for name in found if not any(other.startswith(f"{name}.") for other in found)}


@pytest.mark.parametrize("name", NAMES)
def test_torch_still_has(name):
    try:
        functools.reduce(getattr, name.split(".")[1:], torch)
    except AttributeError:
        pytest.fail(f"torch {torch.__version__} has no {name} any more: see prdp_torch/torch_private.py")


def test_private_names_are_in_one_file_and_all_of_them_are_tested():
    by_file = {path.name: private_names(path) for path in PACKAGE.rglob("*.py")}
    used = by_file.pop("torch_private.py")
    assert {file: names for file, names in by_file.items() if names} == {}
    assert used == {*NAMES}


def test_torch_marks_what_it_does_not_trace_as_before():
    """The marks that `disabled_once_imported` and `_called_while_tracing` set before the compiler is imported."""

    def call():
        pass

    marks = vars(torch_private.disabled_once_imported(call, "for a reason"))
    of_torch = vars(torch.compiler.disable(call, reason="for a reason"))
    assert {name: of_torch[name] for name in marks if "dynamo" in name} == {
        name: value for name, value in marks.items() if "dynamo" in name
    }
    assert len([name for name in marks if "dynamo" in name]) == 2
    of_torch = vars(torch.compiler.assume_constant_result(call))
    assert vars(torch_private._called_while_tracing(lambda: None)).items() <= of_torch.items()


def test_transforms_are_active():
    seen = []

    def f(x):
        seen.append(torch_private.transforms_are_active())
        return x.sum()

    for call in (f, torch.func.grad(f), torch.func.vmap(f), f):
        call(torch.ones(2, 3) if call is not f else torch.ones(2))
    assert seen == [False, True, True, False]


def test_unwrapped_puts_mapped_axes_first():
    x, seen = torch.arange(24.0).reshape(2, 3, 4), []

    def f(v):
        seen.append(torch_private.unwrapped(v))
        return v.sum()

    torch.func.vmap(torch.func.grad(f), in_dims=1)(x)
    assert torch.equal(seen[0], x.movedim(1, 0)) and type(seen[0]) is torch.Tensor
    assert not torch._C._functorch.is_functorch_wrapped_tensor(seen[0])


def test_sparse_tensors_are_read_without_transforms():
    matrix = torch.eye(3).to_sparse_csr()

    def f(v):
        with torch_private.without_transforms():
            values = matrix.values()
        return (values * v).sum()

    assert torch.equal(torch.func.grad(f)(torch.ones(3)), torch.ones(3))


def test_a_number_of_a_module_compiles_once_wherever_the_module_is():
    class Counts(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.k = 1

        def forward(self, x):
            return x * torch_private.number_as_graph_input(self, "k")

    torch._dynamo.reset()
    counter, module = torch._dynamo.testing.CompileCounter(), Counts()
    of_the_script = {"module": module}
    exec("def call(x): return module(x)", of_the_script)
    listed = torch.compiler.config.dynamic_sources
    compiled = torch.compile(of_the_script["call"], backend=counter, fullgraph=True)
    for k in (2, 3, 5, 8, 13):
        module.k = k
        assert torch.equal(compiled(torch.ones(2)), torch.full((2,), float(k)))
    assert counter.frame_count == 1 and torch.compiler.config.dynamic_sources == listed


@pytest.mark.parametrize(
    "move", [lambda m: m.double(), lambda m: m.to(torch.float64), lambda m: m.to_empty(device="cpu")]
)
def test_modules_hear_of_moves(move):
    class Listens(torch_private.HearsOfMoves):
        heard = 0

        def _moved(self, move):
            self.heard += move(torch.ones(1)).shape == (1,)

    outer = torch.nn.Sequential(Listens())
    move(outer)
    assert outer[0].heard == 1
