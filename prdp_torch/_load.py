"""Loads the compiled library, if it was built against the torch at hand.

The C++ interface of torch belongs to one release of it, so 2.13.1 may differ from 2.13.0. What follows a + in the
version, such as cpu or cu130, does not change it.
"""

import importlib
from pathlib import Path

import torch

_BUILT_FOR = Path(__file__).with_name("built_for_torch.txt")
REBUILD = "'pip install --force-reinstall --no-deps .' in the project's folder"


def check_torch() -> None:
    """Raise ImportError in plain words where the compiled library is missing or of another torch."""
    if not _BUILT_FOR.exists():
        raise ImportError(
            "prdp_torch: the compiled library is missing; build it with 'pip install -e .' in the project's folder"
        )
    built_for = _BUILT_FOR.read_text().strip()
    if _release(torch.__version__) != _release(built_for):
        raise ImportError(
            f"prdp_torch was built for torch {built_for}, but torch {torch.__version__} is installed; install "
            f"torch {built_for}, or rebuild prdp_torch for this one with {REBUILD}"
        )


def _release(version: str) -> str:
    return version.partition("+")[0]


def load_library() -> None:
    """Import the compiled library. Raise ImportError in plain words where it does not fit this torch or this Python."""
    check_torch()
    try:
        importlib.import_module("prdp_torch._C")
    except ImportError as error:
        raise ImportError(
            f"prdp_torch was built for another Python, or for another build of torch {torch.__version__}: {error}; "
            f"rebuild it with {REBUILD}"
        ) from error
