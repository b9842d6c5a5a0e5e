"""Two-fragment correlation odometry for a downward camera (papers A and A0)."""
