"""Questions about scenes: verification, accuracy against time, benchmarks, stability regions."""
