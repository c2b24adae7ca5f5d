"""A fit as a page, a picture, a text, and the words and digits of every report."""
