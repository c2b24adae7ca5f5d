"""From unknowns to predicted readings: the law as a table, one row's orbit, what the instrument shows of it."""
