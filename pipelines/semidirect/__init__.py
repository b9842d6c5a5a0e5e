"""Semi-direct visual odometry for a small UAV that looks down, and its PTAM-style baseline (paper C)."""
