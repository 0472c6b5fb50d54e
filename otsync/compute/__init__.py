"""How numbers are crunched: compiled kernels (jit, simd, quaternions), threads, evenly spread indices, and POT."""
