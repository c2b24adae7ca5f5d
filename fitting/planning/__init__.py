"""Which measurements to make next."""
