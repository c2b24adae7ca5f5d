"""Many synthetic tables of one fit, and what is believed after the data."""
