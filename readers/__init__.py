"""Readers: a mission's log in, timestamped samples out.

`open_recording` is the one door. It guesses the format from the content of the file or
folder, not only from its name, and imports the reader of that format when it is needed.
"""
