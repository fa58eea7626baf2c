"""Train your own network through a heat step, solved as accurately as it needs: `python examples/quickstart.py`."""

import torch

import prdp_torch as prdp

torch.manual_seed(0)
u0 = torch.randn(100, 1, 30)
exact = prdp.Heat((30,), nu=1e-3, dt=1.0, solver=prdp.Direct())
u1 = exact(u0)
u2 = exact(u1)

heat = prdp.Heat((30,), nu=1e-3, dt=1.0, solver=prdp.Jacobi(max_iter=1000))
network = torch.nn.Sequential(torch.nn.Linear(30, 64), torch.nn.ReLU(), torch.nn.Linear(64, 30))
optimiser = torch.optim.Adam(network.parameters(), lr=3e-3)
controller = prdp.ToleranceController([heat])
for epoch in range(60):
    for batch in torch.randperm(80).split(20):
        optimiser.zero_grad()
        torch.nn.functional.mse_loss(heat(network(u0[batch])), u2[batch]).backward()
        optimiser.step()
    with torch.no_grad():
        error = (network(u0[80:]) - u1[80:]).norm() / u1[80:].norm()
    if controller.step(error) and heat.info and epoch % 5 == 0:
        taken = heat.info.iterations.float().mean()
        print(
            f"epoch {epoch:2d}  validation error {error:.3f}  tolerance {controller.rtol:.1e}  iterations {taken:.1f}"
        )
print(controller.warning or "The controller warns of nothing.")
