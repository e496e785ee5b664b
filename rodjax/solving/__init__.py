"""From a scene to its equilibrium: searches, stability, choice of the mesh, derivatives, and the result."""
