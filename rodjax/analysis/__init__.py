"""What is asked about an equilibrium: sensitivities, clearance, the exact solution of the continuum."""
