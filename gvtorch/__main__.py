"""`python -m gvtorch`, and the script `gvtorch`."""

import os
import signal
import sys


def main() -> None:
    """Runs the command line. Ctrl-C ends the process at once and silently until a command runs:
    imports take seconds, and nothing needs cleaning up yet.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # closed: a file opened later would get its descriptor
            setattr(sys, name, open(os.devnull, mode))
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from .tools.cli import main as run

    run()


if __name__ == "__main__":
    main()
