"""What a matcher is worth at the end of the chain, in frames of the offset.

run.py     matchers x aligners x rematching; the table and its front
worlds.py  the situations
plot.py    frames against seconds
gate.py    the default chain alone, its errors and its time, against the committed baseline
"""
