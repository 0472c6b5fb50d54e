"""How good a reconstruction is: held-out views, offsets, coherence of the motion."""
