"""The honest benchmark: two independent visits, everything between them done by the pipeline (docs/simulator.md)."""
