"""`python -m fusedrf_cli` is `fusedrf`."""

from fusedrf_cli.main import main

main()
