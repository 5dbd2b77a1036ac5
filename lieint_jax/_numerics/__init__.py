"""Numerical building blocks: arithmetic of small vectors and matrices, Newton's method, special functions."""
