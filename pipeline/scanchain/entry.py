"""Entry point of the command ``scanchain``: Ctrl-C during the imports ends it with one line, too."""

import sys


def main() -> int:
    """Import the command line and run it; 1 if Ctrl-C interrupts the import, as for later interruptions."""
    try:
        from scanchain.__main__ import main as run

        return run()
    except KeyboardInterrupt:
        sys.stderr.write("error: interrupted\n")
        return 1
