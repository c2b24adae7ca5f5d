"""A fit as a page, a picture, a text."""
