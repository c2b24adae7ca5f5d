"""Speeds and delay of each impact from amplitude and phase, without a law."""
