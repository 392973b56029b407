"""The former name of `bcrl.results.verify`."""

import sys

from bcrl.results.verify import main

if __name__ == "__main__":
    sys.exit(main())
