"""How numbers are crunched: compiled kernels (jit, simd, quaternions), threads, and evenly spread indices."""
