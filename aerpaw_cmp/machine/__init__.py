"""Is this machine ready: LLVM, doctor."""
