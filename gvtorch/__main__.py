"""`python -m gvtorch`."""

from .tools.cli import main

main()
