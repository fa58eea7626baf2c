"""Sparse matrices whose indices lie: torch does not check them, so the library must."""

import subprocess
import sys

import pytest
import torch
from helpers import statuses

import prdp_torch as prdp
from prdp_torch.solvers import packed_options

pytestmark = pytest.mark.filterwarnings("ignore:Sparse")

# A process of its own, for what goes wrong here kills it. It says how many matrices were refused.
FUZZ = """
import random, sys, warnings
import torch, prdp_torch as prdp
from prdp_torch.solvers import packed_options
warnings.simplefilter("ignore")
seed, count, n = int(sys.argv[1]), int(sys.argv[2]), 6
draw = random.Random(seed)
solvers = [prdp.Jacobi(3), prdp.SteepestDescent(3), prdp.CG(3), prdp.GMRES(2, restart=3), prdp.Direct()]

def wild(bound):
    huge = [2**62, -(2**62)] if index == torch.int64 else []
    return draw.choice([-1, -2, bound, bound + 1, -(2**31), 2**31 - 1, *huge])

def spoil(crow, col, values, kind):
    if kind == "column":
        col[draw.randrange(len(col))] = wild(n)
    elif kind == "crow":
        crow[draw.randrange(len(crow))] = wild(len(col) + 1)
    elif kind == "falling":
        i = draw.randrange(1, n)
        crow[i], crow[i + 1] = crow[i + 1], crow[i]
    elif kind == "end":
        crow[-1] += draw.choice([-1, 1, 1000])
    elif kind == "start":
        crow[0] = draw.choice([1, 2, -1])
    elif kind == "values":
        del values[draw.randrange(len(values)):]
    elif kind == "columns":
        col += [0] * draw.randrange(1, 4)
    else:
        crow += [crow[-1]] * draw.randrange(1, 3)

refused = 0
for i in range(count):
    index, dtype = draw.choice([torch.int32, torch.int64]), draw.choice([torch.float32, torch.float64])
    rows = [sorted(draw.sample(range(n), draw.randrange(1, n))) for _ in range(n)]
    crow = [sum(map(len, rows[:r])) for r in range(n + 1)]
    col = [c for row in rows for c in row]
    values = [draw.uniform(1, 2) for _ in col]
    kind = draw.choice(["column", "crow", "falling", "end", "start", "values", "columns", "rows"])
    spoil(crow, col, values, kind)
    parts = [torch.tensor(crow, dtype=index), torch.tensor(col, dtype=index), torch.tensor(values, dtype=dtype)]
    batched = draw.random() < 0.3
    if batched:
        parts = [p.expand(2, -1).clone() for p in parts]
    solver, backward = draw.choice(solvers), draw.choice(["implicit", "unrolled"])
    b = torch.ones(2, n, dtype=dtype)
    parts[2].requires_grad_()
    through_op = draw.random() < 0.5
    try:
        if through_op:  # past Python's checks
            options = packed_options(solver.method, 3, 1e-5, 3, None, backward, on_failure="return")
            torch.ops.prdp.linear_solve(b, parts, "csr", [], [], draw.random() < 0.5, None, *options)
        else:
            size = (2, n, n) if batched else (n, n)
            matrix = torch.sparse_csr_tensor(*parts, size=size, check_invariants=False)
            prdp.linear_solve(matrix, b, solver, backward=backward, on_failure="return")
    except ValueError:
        refused += 1
    except RuntimeError as error:  # torch itself has refused to make the tensor
        assert not through_op and "crow_indices" in str(error), (kind, error)
        refused += 1
    else:
        raise AssertionError(f"accepted: {kind} {crow} {col} {through_op}")
print("refused", refused)
"""


@pytest.mark.parametrize("seed", range(2))
def test_a_malformed_matrix_is_refused_and_kills_nothing(seed):
    count = 600
    done = subprocess.run(
        [sys.executable, "-c", FUZZ, str(seed), str(count)], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, (done.returncode, done.stderr[-2000:])
    assert done.stdout == f"refused {count}\n"


def csr(crow, col, values, index=torch.int64):
    return [torch.tensor(crow, dtype=index), torch.tensor(col, dtype=index), torch.tensor(values, dtype=torch.float64)]


def solve(parts, solver="direct", b=None):
    b = torch.ones(1, 2, dtype=torch.float64) if b is None else b
    options = packed_options(solver, 3, 1e-5, 3, None, on_failure="return")
    return torch.ops.prdp.linear_solve(b, parts, "csr", [], [], False, None, *options)


@pytest.mark.parametrize(
    "crow, col, values, message",
    [
        ([0, 1, 2], [0, 2], [1.0, 1.0], r"a column of a CSR matrix of 2 rows must lie in \[0, 2\), got 2 at index 1"),
        ([0, 1, 2], [-1, 1], [1.0, 1.0], r"must lie in \[0, 2\), got -1 at index 0"),
        ([0, 3, 2], [0, 1], [1.0, 1.0], "crow of a CSR matrix must not fall, got 3 before 2 at index 1"),
        ([0, 1, 3], [0, 1], [1.0, 1.0], "must run from 0 to the 2 stored values, got 0 to 3"),
        ([1, 1, 2], [0, 1], [1.0, 1.0], "must run from 0 to the 2 stored values, got 1 to 2"),
        ([0, 1, 2], [0, 1], [1.0], r"as many columns as values, got \[2\] and \[1\]"),
        ([0], [], [], "A must have at least one row"),
        ([], [], [], "A must have at least one row"),
    ],
)
def test_the_message_says_what_is_wrong(crow, col, values, message):
    with pytest.raises(ValueError, match=message):
        solve(csr(crow, col, values))


def test_batch_axes_and_index_types_must_fit():
    crow, col, values = csr([0, 1, 2], [0, 1], [1.0, 1.0])
    with pytest.raises(ValueError, match="must have the same batch axis"):
        solve([crow.expand(3, 3), col, values])
    with pytest.raises(ValueError, match="must have the same batch axis"):
        solve([crow.expand(2, 3), col.expand(3, 2), values.expand(3, 2)])
    with pytest.raises(TypeError, match="indices of a CSR matrix must be int32 or int64, got float64"):
        solve([crow.double(), col, values])
    with pytest.raises(ValueError, match="indices and values of a CSR matrix must be on one device"):
        solve([crow.to("meta"), col, values])
    made = torch.sparse_csr_tensor(crow, col, values, size=(5, 5), check_invariants=False)
    with pytest.raises(ValueError, match="a CSR matrix of 5 rows needs a crow of one more, got 3"):
        prdp.linear_solve(made, torch.ones(5, dtype=torch.float64), prdp.CG(3))


def test_indices_changed_after_the_operator_was_made_are_checked_again():
    a = prdp.operators.Matrix(torch.eye(4, dtype=torch.float64).to_sparse_csr())
    a.tensors[1][2] = 1000
    with pytest.raises(ValueError, match="must lie in"):
        prdp.linear_solve(a, torch.ones(4, dtype=torch.float64), prdp.Jacobi(3))


@pytest.mark.parametrize("index", [torch.int32, torch.int64])
def test_unsorted_and_repeated_columns_add_up(index):
    """As in SciPy: torch would not make them, but they say which matrix is meant."""
    parts = csr([0, 3, 5], [1, 0, 1], [1.0, 4.0, 0.5], index)
    parts = [parts[0], torch.cat([parts[1], parts[1][:2]]), torch.cat([parts[2], torch.tensor([3.0, 1.0])])]
    dense = torch.tensor([[4.0, 1.5], [1.0, 3.0]], dtype=torch.float64)
    b = torch.tensor([[1.0, 2.0]], dtype=torch.float64)
    for solver in ("direct", "gmres"):
        torch.testing.assert_close(solve(parts, solver, b)[0], torch.linalg.solve(dense, b[0])[None])


HANGS = """
import torch, prdp_torch as prdp
for n in (1, 3, 24, 40, 45):
    diagonal = [(i, i) for i in range(n - 1)]
    for entries in ([], [(0, 0)], diagonal, [(i, 0) for i in range(n)], [(0, i) for i in range(n)]):
        if n == 1 and entries:
            continue
        dense = torch.zeros(n, n, dtype=torch.float64)
        for i, j in entries:
            dense[i, j] = 1.0
        for matrix in (dense.to_sparse_csr(), dense.expand(2, n, n).clone().to_sparse_csr()):
            b = torch.ones(2, n, dtype=torch.float64)
            u, info = prdp.linear_solve(matrix, b, prdp.Direct(), on_failure="return")
            assert [prdp.SolveStatus(int(s)).name for s in info.status] == ["BREAKDOWN"] * 2, (n, entries, info)
print("all broke down")
"""


def test_direct_on_a_matrix_with_an_empty_line_breaks_down_at_once():
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", HANGS], capture_output=True, text=True, timeout=100)
    assert done.stdout == "all broke down\n", (done.returncode, done.stderr)


@pytest.mark.parametrize("matrix", [torch.zeros(0, 0), torch.zeros(0, 0).to_sparse_csr(), torch.zeros(3, 0, 0)])
def test_a_matrix_without_rows_is_refused(matrix):
    with pytest.raises(ValueError, match="A must have at least one row"):
        prdp.linear_solve(matrix, torch.zeros(3, 0), prdp.Direct())


def test_an_empty_batch_is_solved():
    u, info = prdp.linear_solve(torch.eye(3).to_sparse_csr(), torch.zeros(0, 3), prdp.Direct())
    assert u.shape == (0, 3) and statuses(info) == []


def test_a_row_of_thousands_of_entries_is_summed_to_the_dtype():
    """A star: in float32, one sum after another lost a hundred times the tolerance, and the status did not see it."""
    n = 10_000
    g = torch.Generator().manual_seed(0)
    weights = torch.rand(n - 1, generator=g)
    crow = torch.cat([torch.tensor([0, n]), torch.arange(n + 1, 2 * n)])
    columns = torch.cat([torch.arange(n), torch.arange(1, n)])
    values = torch.cat([torch.ones(1), weights, torch.ones(n - 1)])
    a = prdp.operators.Matrix.csr(crow, columns, values, (n, n))
    b = torch.rand(n, generator=g)
    exact = b.double().clone()
    exact[0] -= weights.double() @ exact[1:]
    for solver in (prdp.GMRES(4, rtol=1e-5), prdp.BiCGStab(9, rtol=1e-5), prdp.Jacobi(9, rtol=1e-5)):
        u, info = prdp.linear_solve(a, b, solver)
        residual = u.double().clone()
        residual[0] += weights.double() @ residual[1:]
        assert info.solved.all() and (residual - b).norm() < 5e-6 * b.norm()
        assert abs(u[0].double() - exact[0]) < 1e-3  # of some 2,500
