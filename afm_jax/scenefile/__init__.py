"""Scenes as TOML files, and the paper's by name."""
