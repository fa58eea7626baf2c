"""What the tests of torch.func share: comparisons of nested results, and the ways to a second derivative."""

import torch
from torch.func import hessian, jacfwd, jacrev
from torch.utils._pytree import tree_leaves

EXACT = {"rtol": 1e-10, "atol": 1e-12}
SECOND = [hessian, lambda f, n: jacrev(jacrev(f, n), n), lambda f, n: jacrev(jacfwd(f, n), n),
          lambda f, n: jacfwd(jacfwd(f, n), n)]  # fmt: skip
SECOND_NAMES = ["forward over reverse", "reverse over reverse", "reverse over forward", "forward over forward"]


def close(found, expected, **tolerance):
    found, expected = tree_leaves(found), tree_leaves(expected)
    assert len(found) == len(expected)
    for f, e in zip(found, expected, strict=True):
        torch.testing.assert_close(f, e, **(tolerance or EXACT))
