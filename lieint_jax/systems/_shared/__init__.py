"""Code shared by several systems."""
