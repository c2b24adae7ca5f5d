"""Many synthetic tables of one fit, and their posterior."""
