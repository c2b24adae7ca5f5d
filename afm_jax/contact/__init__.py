"""The resolved impact: liquid bridge, JKR junction, and a free tip that goes through both (section IV)."""
