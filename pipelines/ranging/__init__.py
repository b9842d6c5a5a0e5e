"""Range to landmarks from a monocular image and the camera's own motion (paper B)."""
