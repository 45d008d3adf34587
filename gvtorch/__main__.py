"""`python -m gvtorch`, and the script `gvtorch`."""

import signal


def main() -> None:
    """Runs the command line. Until a command runs there is nothing to put in order, but seconds of
    imports to interrupt: Ctrl-C ends the process at once, without a word.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from .tools.cli import main as run

    run()


if __name__ == "__main__":
    main()
