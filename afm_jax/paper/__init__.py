"""The paper's figures, with what it says of them checked on their data."""
