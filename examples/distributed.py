"""Train a network on several processes in a loop of your own: torchrun --nproc-per-node 2 examples/distributed.py

Where there are enough GPUs, each process takes one and NCCL sums the gradients. Otherwise all of it is on the CPU.
"""

import os

import torch
from torch import distributed
from torch.nn.parallel import DistributedDataParallel

import prdp_torch as prdp

local, processes_here = int(os.environ["LOCAL_RANK"]), int(os.environ["LOCAL_WORLD_SIZE"])
on_gpus = torch.cuda.device_count() >= processes_here
device = torch.device("cuda", local) if on_gpus else torch.device("cpu")
if on_gpus:
    torch.cuda.set_device(device)
distributed.init_process_group("nccl" if on_gpus else "gloo")
rank, processes = distributed.get_rank(), distributed.get_world_size()
torch.manual_seed(0)  # the same data and weights in every process
u0 = torch.randn(128, 1, 30).to(device)
exact = prdp.Heat(shape=(30,), nu=1e-3, dt=1.0, solver=prdp.Direct())
u2 = exact(exact(u0))
mine = torch.arange(100).tensor_split(processes)[rank]  # training samples of this process
valid = torch.arange(100, 128).tensor_split(processes)[rank]

layers = (torch.nn.Flatten(), torch.nn.Linear(30, 100), torch.nn.ReLU(), torch.nn.Linear(100, 30))
network = DistributedDataParallel(torch.nn.Sequential(*layers, torch.nn.Unflatten(1, (1, 30))).to(device))
optimiser = torch.optim.Adam(network.parameters(), lr=3e-3)
heat = prdp.Heat(shape=(30,), nu=1e-3, dt=1.0, solver=prdp.Jacobi(max_iter=1))
controller = prdp.PRDPController([heat], tau_step=0.98)

for _ in range(40):
    for batch in mine[torch.randperm(len(mine))].split(25):
        optimiser.zero_grad()
        torch.nn.functional.mse_loss(heat(network(u0[batch])), u2[batch]).backward()
        optimiser.step()
    with torch.no_grad():
        error = (exact(network(u0[valid])) - u2[valid]).square().mean() / u2[valid].square().mean()
    # Every process gives the error of its own samples. All of them see the mean, and refine in the same epoch.
    controller.step(error)
print(f"process {rank} of {processes}: error {controller.history[-1].metric:.3f}, K = {heat.max_iter}", flush=True)
distributed.barrier()  # gloo may abort a process whose partner has left first
del network  # It holds the group, and so the group's threads. One that outlives Python aborts the process.
distributed.destroy_process_group()
