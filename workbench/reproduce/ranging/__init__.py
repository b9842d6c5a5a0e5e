"""Paper B's experiments: the simulation of its section 4, and a simulated replica of its robot's run."""
