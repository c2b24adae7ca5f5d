"""Frequency and quality factor of a free cantilever from a resonance sweep."""
