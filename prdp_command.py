"""Entry of the command `prdp`, outside the package: importing that takes a second, for torch."""

import os
import signal
import sys


def _refused(error):
    """The exit status of a package that is not built, or built for another torch."""
    print(f"prdp: {error}", file=sys.stderr)
    return 2


def main():
    at_start = signal.getsignal(signal.SIGINT)
    if at_start is signal.default_int_handler:  # not where Ctrl-C is ignored, as in the background
        signal.signal(signal.SIGINT, lambda *_: os._exit(130))  # nothing is open yet that would need closing
    try:
        from prdp_torch import cli
    except ImportError as error:
        sys.exit(_refused(error))

    signal.signal(signal.SIGINT, at_start)
    cli.main()
