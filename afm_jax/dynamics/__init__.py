"""Which orbits there are and which last, over planes and lines of parameters."""
