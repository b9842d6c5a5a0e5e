"""The workbench: steps into Rerun recordings, run folders, summaries and the command line."""
