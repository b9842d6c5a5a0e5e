"""Semi-direct visual odometry of a camera that looks down (paper C; Forster, Pizzoli, Scaramuzza, ICRA 2014)."""
