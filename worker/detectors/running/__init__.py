"""How networks are run: calls in batches that fit into the memory, shared by steps, of models that are kept warm."""
