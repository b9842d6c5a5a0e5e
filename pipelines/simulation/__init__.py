"""Simulated missions whose truth is known exactly: surfaces, trajectories, a renderer, recordings.

World and body: z up, x forward, y left, headings counter-clockwise seen from above. The camera looks
straight down; its image has u along body x (forward) and v along minus body y (to the right).
"""
