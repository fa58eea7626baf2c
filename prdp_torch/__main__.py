"""`python -m prdp_torch`: the command `prdp`, for launchers such as torchrun that start a module."""

from prdp_command import main

main()
