"""Pipelines: samples in, steps out. No files, no Rerun, no printing."""
