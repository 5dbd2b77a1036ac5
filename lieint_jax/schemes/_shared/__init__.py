"""Code shared by several schemes."""
