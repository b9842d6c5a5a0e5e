"""Paper C's comparison of visual odometries on flights of a small UAV: Figs 3-5 and its frame rates."""
