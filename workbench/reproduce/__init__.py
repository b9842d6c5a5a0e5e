"""Experiments of the papers, repeated on simulated missions, with the papers' numbers beside ours."""
