"""Free resonance sweeps: reading, model, errors, report."""
