"""`python -m service` is `spicd`."""

from service.cli import main

main()
