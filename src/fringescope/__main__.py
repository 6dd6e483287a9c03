"""`python -m fringescope`: the command line."""

from fringescope.cli import main

main()
