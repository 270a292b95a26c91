"""Lets ``python -m vcbf_drake`` be the command line."""

from vcbf_drake.cli import main

main()
