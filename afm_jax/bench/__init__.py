"""Timings on fixed problems, SciPy beside them."""
