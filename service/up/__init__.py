"""`spicd up`: the service, its workers and its Redis as one command."""
