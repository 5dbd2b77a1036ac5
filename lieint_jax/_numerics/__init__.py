"""Arithmetic that the package is made of: small vectors and matrices, Newton's method, special functions."""
