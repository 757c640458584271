"""Start ``gen-dataset``, also as ``python -m unprocess_gen``.

Importing the command takes 0.1 s, in which Ctrl-C would print a traceback. From then on `cli.signals` handles signals.
"""

import os
import signal
import sys


def main() -> int:
    """Import the command and run it with the arguments of this process."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # otherwise the caller ignores it
        signal.signal(signal.SIGINT, _end)
    from unprocess_gen.cli import main as command

    return command.main()


def _end(number: int, frame: object) -> None:
    """End the process; an exception could be dropped in a callback of the import system."""
    try:
        os.write(2, b"gen-dataset: interrupted\n")
    finally:
        os._exit(128 + number)


if __name__ == "__main__":
    sys.exit(main())
