"""Which drives to measure next, and what they will tell."""
