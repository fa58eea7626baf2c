"""`python -m prdp_torch`: the command `prdp`, for launchers such as torchrun that start a module."""

from prdp_torch.experiments.cli import main

main()
