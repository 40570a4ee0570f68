"""To views: rigs, lighting, rendering, and the procedural shapes that need no data set."""
