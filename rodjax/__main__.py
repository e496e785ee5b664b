"""`python -m rodjax` is the command `rodjax`."""

import sys

from rodjax.cli import main

if __name__ == "__main__":
    sys.exit(main())
