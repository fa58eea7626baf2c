"""Checks, before the compiled library is loaded, that it was built against the torch at hand."""

from pathlib import Path

import torch

_BUILT_FOR = Path(__file__).with_name("built_for_torch.txt")


def check_torch():
    """Raise ImportError in plain words where the compiled library is missing or of another torch."""
    if not _BUILT_FOR.exists():
        raise ImportError(
            "prdp_torch: the compiled library is missing; build it with "
            "'pip install --no-build-isolation -e .' in the project's folder"
        )
    built_for = _BUILT_FOR.read_text().strip()
    if torch.__version__ != built_for:
        raise ImportError(
            f"prdp_torch was built for torch {built_for}, but torch {torch.__version__} is installed; install "
            f"torch {built_for}, or rebuild prdp_torch for this one with 'pip install --no-build-isolation "
            "--force-reinstall --no-deps .' in the project's folder"
        )
