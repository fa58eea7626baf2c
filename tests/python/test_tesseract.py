"""examples/mosaic: the flow that the Tesseract computes, against `Flow` itself; and the Tesseract, where tesseract-core
is installed: `VENV/bin/python -m pytest tests/python/test_tesseract.py`."""

import importlib.util
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

FOLDER = Path(__file__).parents[2] / "examples" / "mosaic"


@pytest.fixture
def rollout(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(FOLDER), *sys.path])
    spec = importlib.util.spec_from_file_location("rollout", FOLDER / "rollout.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.rollout


def taylor_green(n, dtype=np.float32):
    """u = sin x cos y, v = -cos x sin y in the centres of the cells of [0, 2π]²."""
    x, y = np.meshgrid(*[2 * math.pi * (np.arange(n) + 0.5) / n] * 2, indexing="ij")
    return np.stack([np.sin(x) * np.cos(y), -np.cos(x) * np.sin(y)], -1)[:, :, None].astype(dtype)


def test_a_vortex_decays_as_it_should(rollout):
    v0 = torch.from_numpy(taylor_green(64, np.float64))
    found = rollout(v0, torch.tensor([0.05]).double(), 0.01, 20, 2 * math.pi, ["periodic"])
    assert found.shape == (64, 64, 1, 2)
    assert float((found - math.exp(-0.1 * 0.2) * v0).norm() / v0.norm()) < 3e-3


def test_axes_are_in_the_order_x_y_z(rollout):
    y = (torch.arange(12, dtype=torch.float64) + 0.5) / 12
    v0 = torch.zeros(6, 12, 1, 2, dtype=torch.float64)
    v0[..., 0] = (y * (1 - y))[None, :, None]
    found = rollout(v0, torch.tensor(0.1), 1e-2, 3, 1.0, ["periodic", "wall"])
    assert float((found - found[:1]).abs().max()) < 1e-7 and float(found[..., 1].abs().max()) < 1e-7
    assert float(found[0, 0, 0, 0]) < 0.95 * float(v0[0, 0, 0, 0])
    cube = torch.zeros(4, 5, 6, 3, dtype=torch.float64)
    cube[..., 2] = 1.0
    torch.testing.assert_close(rollout(cube, torch.tensor(0.1), 1e-2, 2, 1.0, ["periodic"]), cube)


def test_gradients_are_central_differences(rollout):
    v0 = torch.from_numpy(taylor_green(8, np.float64)).requires_grad_()
    nu = torch.tensor([0.05], dtype=torch.float64, requires_grad=True)
    direction = torch.randn(v0.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def energy(v, viscosity):
        return rollout(v, viscosity, 0.05, 4, 2 * math.pi, ["periodic"]).square().sum()

    of_v0, of_nu = torch.autograd.grad(energy(v0, nu), [v0, nu])
    h = 1e-4
    with torch.no_grad():
        along = (energy(v0 + h * direction, nu) - energy(v0 - h * direction, nu)) / (2 * h)
        in_nu = (energy(v0, nu + h) - energy(v0, nu - h)) / (2 * h)
    assert float((of_v0 * direction).sum()) == pytest.approx(float(along), rel=1e-4)
    assert float(of_nu) == pytest.approx(float(in_nu), rel=1e-4)


def test_the_tesseract_has_the_same_results_and_gradients(rollout):
    tesseract_core = pytest.importorskip("tesseract_core")
    flow = tesseract_core.Tesseract.from_tesseract_api(str(FOLDER / "tesseract_api.py"))
    inputs = {
        "v0": taylor_green(16), "viscosity": np.float32([0.05]), "dt": np.float32([0.05]), "steps": 4,
        "domain_extent": 2 * math.pi,
    }  # fmt: skip
    v0, nu = (torch.from_numpy(inputs[name]).requires_grad_() for name in ("v0", "viscosity"))
    expected = rollout(v0, nu, float(inputs["dt"][0]), 4, 2 * math.pi, ["periodic"])
    result = flow.apply(inputs)["result"]
    np.testing.assert_allclose(result, expected.detach(), rtol=1e-6, atol=1e-7)
    found = flow.vector_jacobian_product(inputs, ["v0", "viscosity"], ["result"], {"result": 2 * result})
    of_v0, of_nu = torch.autograd.grad(expected.square().sum(), [v0, nu])
    np.testing.assert_allclose(found["v0"], of_v0, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found["viscosity"], of_nu, rtol=1e-5)
    with pytest.raises(Exception, match="wall"):
        flow.apply({**inputs, "boundary": ["slippery"]})
