"""The rule without training: hit by one visit, seen through by the other."""
