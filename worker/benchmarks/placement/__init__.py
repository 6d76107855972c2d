"""The placement benchmark: whether poses of surveys are believed where they should be, and nowhere else."""
