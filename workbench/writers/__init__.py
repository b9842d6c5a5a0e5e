"""A `Recording` written into a container that other tools open: MCAP, ROS bags, folders of images.

What is written is a function of the samples: the same recording gives the same bytes.
"""

from workbench.writers.door import Container, write, write_mcap
from workbench.writers.target import ImageFormat, Written

__all__ = ["Container", "ImageFormat", "Written", "write", "write_mcap"]
