"""Patrol: what a camera sees of the ground, paths that sweep an area, and whether a flight swept it (paper C)."""
