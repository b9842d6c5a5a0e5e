"""Patrol on files: areas in, plans out, a flight held against its plan."""
