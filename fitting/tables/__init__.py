"""The parts of an amplitude table: columns, comments, rows, faults."""
