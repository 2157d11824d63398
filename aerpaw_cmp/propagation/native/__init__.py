"""Compiled kernels: when to use them, where to keep them; and the LLVM that Dr.Jit compiles with."""
