"""The instantaneous (or delayed) impact: law, first impact, Poincare map, Jacobian, single-impact orbits."""
