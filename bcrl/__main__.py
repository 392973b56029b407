"""`python -m bcrl`, as the command `bcrl`."""

from bcrl.cli import main

main()
