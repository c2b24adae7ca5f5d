"""Law scenes in time."""


def follow_law(*args, **kwargs):
    """Not written yet."""
    raise NotImplementedError
