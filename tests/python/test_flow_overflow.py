"""What a Flow says of a velocity near the largest number of its dtype."""

import pytest
import torch
from fibers import Fibers

import prdp_torch as prdp


def state(velocity):
    u = torch.full((2, 2, 8, 8), 1e-3)
    u[1] = velocity
    return u


@pytest.mark.parametrize("device", [None, {"threads": 32}], ids=["cpu", "kernel"])
@pytest.mark.parametrize(("velocity", "status"), [(1e38, -3), (torch.nan, -8), (torch.inf, -8)])
def test_a_finite_velocity_that_is_too_fast_has_diverged(velocity, status, device):
    flow = prdp.Flow((8, 8), 1e-3, 10.0, on_failure="return")
    if device is None:
        u = flow(state(velocity))
    else:
        with Fibers(**device):
            u = flow(state(velocity))
    assert flow.info.status[0] > 0 and flow.info.status[1] == status and u[0].isfinite().all()


def test_its_message_names_the_number_that_is_too_large():
    with pytest.raises(torch.linalg.LinAlgError, match=r"sample 1 DIVERGED: dt Σ \|u\|/dx is inf, and the explicit"):
        prdp.Flow((8, 8), 1e-3, 10.0)(state(1e38))
