"""Entry of the command `prdp`, outside the package: importing that takes a second, for torch."""

import os
import signal
import sys


def _refused(error: ImportError) -> int:
    """The exit status where a package is missing, not built, or built for another torch."""
    missing = isinstance(error, ModuleNotFoundError) and not error.name.startswith("prdp_torch")
    hint = "; the command needs pip install 'prdp_torch[experiments]'" if missing else ""
    print(f"prdp: {error}{hint}", file=sys.stderr)
    return 2


def main() -> None:
    at_start = signal.getsignal(signal.SIGINT)
    if at_start is signal.default_int_handler:  # not where Ctrl-C is ignored, as in the background
        signal.signal(signal.SIGINT, lambda *_: os._exit(130))  # nothing is open yet that would need closing
    try:
        from prdp_torch.experiments import cli
    except ImportError as error:
        sys.exit(_refused(error))

    signal.signal(signal.SIGINT, at_start)
    cli.main()
