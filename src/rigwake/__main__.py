"""`python -m rigwake`: the command line."""

from rigwake.cli.main import main

main()
