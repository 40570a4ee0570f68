"""One photo of an object, or a few, becomes a textured 3D mesh or Gaussian splats."""

import os

__version__ = "0.1.0"

# Threads that wait for work sleep: where other programs want the processor, spinning makes us ten times slower.
# libgomp, torch's threads, reads this when torch is first imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
