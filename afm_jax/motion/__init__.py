"""A scene in time: simulation of any interaction, and what is read off a motion."""
