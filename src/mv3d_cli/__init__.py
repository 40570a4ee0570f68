"""One photo of an object, or a few, becomes a textured 3D mesh or Gaussian splats."""

__version__ = "0.1.0"
