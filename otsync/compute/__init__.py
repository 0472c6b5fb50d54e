"""What is compiled: how (jit), on which threads, SIMD lanes, and quaternions inside kernels."""
