"""Entry of the command `prdp`, outside the package: importing that takes a second, for torch."""

import os
import signal


def main():
    at_start = signal.getsignal(signal.SIGINT)
    if at_start is signal.default_int_handler:  # not where Ctrl-C is ignored, as in the background
        signal.signal(signal.SIGINT, lambda *_: os._exit(130))  # nothing is open yet that would need closing
    from prdp_torch import cli

    signal.signal(signal.SIGINT, at_start)
    cli.main()
