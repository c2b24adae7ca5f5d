"""From a deflection in time to response order, amplitudes and phase."""
