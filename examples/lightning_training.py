"""PRDP in PyTorch Lightning: the controller acts after each validation, and its state is in the checkpoint.

Needs `pip install lightning`.
"""

from typing import Any

import lightning
import torch
from torch import Tensor
from torch.utils.data import DataLoader, TensorDataset, random_split

import prdp_torch as prdp

SAMPLES, POINTS = 100, 30


class Emulator(lightning.LightningModule):
    """A network learns one step of the heat equation, through the next step's solve."""

    def __init__(self) -> None:
        super().__init__()
        self.network = torch.nn.Sequential(
            torch.nn.Linear(POINTS, 64), torch.nn.ReLU(), torch.nn.Linear(64, 64), torch.nn.ReLU(),
            torch.nn.Linear(64, POINTS),
        )  # fmt: skip
        self.heat = prdp.Heat(shape=(POINTS,), nu=1e-3, dt=1.0, solver=prdp.Jacobi(max_iter=1))
        self.controller = prdp.PRDPController([self.heat])

    def training_step(self, batch: list[Tensor], _: int) -> Tensor:
        start, end = batch
        return torch.nn.functional.mse_loss(self.heat(self.network(start)), end)

    def validation_step(self, batch: list[Tensor], _: int) -> None:
        start, end = batch
        error = (self.network(self.network(start)) - end).square().mean() / end.square().mean()
        self.log("error", error, sync_dist=True)  # the mean over all processes

    def on_validation_epoch_end(self) -> None:
        if not self.trainer.sanity_checking:
            self.controller.step(self.trainer.callback_metrics["error"])  # sets heat.max_iter

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["controller"] = self.controller.state_dict()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.controller.load_state_dict(checkpoint["controller"])

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.Adam(self.parameters(), lr=2e-3)


def make_loaders() -> tuple[DataLoader[tuple[Tensor, ...]], DataLoader[tuple[Tensor, ...]]]:
    torch.manual_seed(0)
    x, n = torch.arange(1, POINTS + 1) / (POINTS + 1), torch.arange(1, 6)[:, None]
    waves = torch.cat([torch.sin(2 * torch.pi * n * x), torch.cos(2 * torch.pi * n * x)])
    start = ((2 * torch.rand(SAMPLES, 10) - 1) @ waves)[:, None]
    exact = prdp.Heat(shape=(POINTS,), nu=1e-3, dt=1.0, solver=prdp.Direct())
    samples = TensorDataset(start, exact(exact(start)))
    train, valid = random_split(samples, [SAMPLES - 20, 20])
    return DataLoader(train, batch_size=20), DataLoader(valid, batch_size=20)


def fit(epochs: int, folder: str, resume_from: str | None = None) -> Emulator:
    """Train up to so many epochs, from the start or from a checkpoint. Returns the trained module."""
    torch.manual_seed(1)
    emulator = Emulator()
    trainer = lightning.Trainer(
        max_epochs=epochs, default_root_dir=folder, accelerator="cpu", logger=False, enable_progress_bar=False,
        enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(emulator, *make_loaders(), ckpt_path=resume_from, weights_only=True)
    trainer.save_checkpoint(f"{folder}/epoch_{epochs}.ckpt")
    return emulator


if __name__ == "__main__":
    fit(20, "runs/lightning")
    emulator = fit(60, "runs/lightning", resume_from="runs/lightning/epoch_20.ckpt")
    history = emulator.controller.history
    print("K over the epochs:", [record.max_iter for record in history])
    print(f"error {history[-1].metric:.3f} with K = {emulator.heat.max_iter}")
