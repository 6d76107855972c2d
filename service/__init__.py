"""The HTTP service and everything recorded; imports neither torch, open3d nor the worker."""
