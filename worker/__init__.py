"""Everything a job does: the pipeline, the detectors, their training and evaluation."""
