"""Find the 3D position of an unknown tool's tip in a robot's hand from images and joint angles."""

__version__ = "0.1.0"
