"""Compiled kernels: when to use them, where to keep them."""
