"""From readings to a law: unknowns with priors, one least squares, its search and its result."""
